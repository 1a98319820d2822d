//! What reading has to say.

use std::collections::HashMap;

/// Notes in the order in which they came up, each once, with how often it did. Primitives of a mesh at many nodes would otherwise say the
/// same as often as a small file likes.
#[derive(Default)]
pub(super) struct Notes {
    /// When each first came up, and how often.
    counts: HashMap<String, (usize, usize)>,
}

impl Notes {
    /// Takes in all of `notes`, and leaves none.
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
