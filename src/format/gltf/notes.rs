//! Notes collected while reading.

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
