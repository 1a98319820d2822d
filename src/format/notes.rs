//! Notes of readers, one sentence each. Many begin with the place that they are about: `/materials/3: `.

use std::collections::HashMap;

/// Notes in order of first occurrence, each once, with its count. Otherwise primitives of a mesh used by many nodes
/// would repeat a note as often as a small file can make them.
#[derive(Default)]
pub(super) struct Notes {
    /// Order of first occurrence, and count, per note.
    counts: HashMap<String, (usize, usize)>,
}

impl Notes {
    /// Moves all of `notes` into the collection.
    pub(super) fn take(&mut self, notes: &mut Vec<String>) {
        for note in notes.drain(..) {
            let next = self.counts.len();
            self.counts.entry(note).or_insert((next, 0)).1 += 1;
        }
    }

    pub(super) fn into_lines(self) -> Vec<String> {
        let mut notes: Vec<_> = self.counts.into_iter().collect();
        notes.sort_unstable_by_key(|(_, (first, _))| *first);
        let line = |(note, (_, count))| if count == 1 { note } else { format!("{note} ({count} times)") };
        notes.into_iter().map(line).collect()
    }
}

/// Number of places that a note names at most.
const NAMED: usize = 3;

/// Notes that say the same of several places as one, where the first of them is. It names the first few places, and the
/// number of the others.
pub(super) fn grouped(notes: &[String]) -> Vec<String> {
    let mut groups: Vec<(&str, Vec<&str>)> = vec![];
    let mut known: HashMap<&str, usize> = HashMap::new();
    for note in notes {
        let Some((place, said)) = placed(note) else {
            groups.push((note.as_str(), vec![]));
            continue;
        };
        let next = groups.len();
        let group = *known.entry(said).or_insert(next);
        if group == next {
            groups.push((said, vec![]));
        }
        groups[group].1.push(place);
    }
    groups.into_iter().map(|(said, places)| line(said, &places)).collect()
}

/// Place of a note, a JSON pointer or the path of a prim, and what is said of it.
fn placed(note: &str) -> Option<(&str, &str)> {
    note.split_once(": ").filter(|(place, _)| place.starts_with('/') && !place.contains(char::is_whitespace))
}

fn line(said: &str, places: &[&str]) -> String {
    let more = places.len().saturating_sub(NAMED);
    let named = places[..places.len() - more].join(", ");
    match (places.is_empty(), more) {
        (true, _) => said.to_owned(),
        (false, 0) => format!("{named}: {said}"),
        (false, more) => format!("{named} and {more} more: {said}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_said_of_many_places_is_said_once() {
        let unlit = "only its base colour is shown, unlit";
        let mut notes: Vec<String> = (0..60).map(|i| format!("/materials/{i}: {unlit}")).collect();
        notes.insert(0, "metersPerUnit is not stated: lengths are not converted".to_owned());
        notes.insert(2, "/nodes/1: camera left out: it is orthographic".to_owned());
        notes.extend(["/W/A: hidden", "/W/B: hidden", "of two: parts", "of two: parts"].map(str::to_owned));
        let many = format!("/materials/0, /materials/1, /materials/2 and 57 more: {unlit}");
        let expected = [
            "metersPerUnit is not stated: lengths are not converted",
            many.as_str(),
            "/nodes/1: camera left out: it is orthographic",
            "/W/A, /W/B: hidden",
            "of two: parts",
            "of two: parts",
        ];
        assert_eq!(grouped(&notes), expected);
        assert_eq!(grouped(&expected.map(str::to_owned)), expected, "once is enough");
    }
}
