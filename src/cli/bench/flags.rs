//! Flags of `centaur train` in a benchmark: those that a protocol or a job determines, those of scenes, and how they
//! are kept in results.

use std::collections::BTreeSet;
use std::path::Path;

/// Flags of `centaur train` that a protocol determines, and which would override it.
const OF_PROTOCOL: [&str; 4] = ["--images", "--downscale", "--max-side", "--masks"];

/// Flags of [`OF_PROTOCOL`] that set the size, each in its way.
pub(super) const OF_SIZE: [&str; 2] = ["--downscale", "--max-side"];

/// Whether a word among flags of `centaur train` determines which photographs are used, at which size, or which part of
/// them.
pub(super) fn chooses_pictures(word: &str) -> bool {
    is_one_of(word, &OF_PROTOCOL)
}

/// Whether a word is one of these flags, with or without its value attached.
pub(super) fn is_one_of(word: &str, flags: &[&str]) -> bool {
    name_of(word).is_some_and(|name| flags.contains(&name))
}

/// Name of the flag in a word, with or without its value, which may follow a short flag without `=`; none if the word
/// is a value, such as `-1.5`.
fn name_of(word: &str) -> Option<&str> {
    let is_long = word.starts_with("--");
    let is_short = word.strip_prefix('-').is_some_and(|name| name.starts_with(char::is_alphabetic));
    if is_long { word.split('=').next() } else { word.get(..2).filter(|_| is_short) }
}

/// Flags of a scene that remain beside those of the command and the variant: without flags that these give as well, and
/// without its size if they set one, because sizes exclude each other.
pub(super) fn left_of(of_scene: &[String], others: &[String]) -> Vec<String> {
    let given: BTreeSet<&str> = others.iter().filter_map(|word| name_of(word)).collect();
    let is_sized = OF_SIZE.iter().any(|flag| given.contains(flag));
    let mut is_left = true;
    let stays = |word: &&String| {
        if let Some(name) = name_of(word) {
            is_left = !(given.contains(name) || is_sized && OF_SIZE.contains(&name));
        }
        is_left
    };
    of_scene.iter().filter(stays).cloned().collect()
}

/// Flags as stored in results: for weights the file name only, because folders differ between machines.
pub(super) fn as_kept(flags: &[String]) -> Vec<String> {
    let name = |path: &str| Path::new(path).file_name().map_or(path.to_owned(), |name| name.to_string_lossy().into());
    let mut kept: Vec<String> = vec![];
    for word in flags {
        let is_value = kept.last().is_some_and(|before| before == WEIGHTS);
        kept.push(match word.split_once('=') {
            _ if is_value => name(word),
            Some((flag, path)) if flag == WEIGHTS => format!("{flag}={}", name(path)),
            _ => word.clone(),
        });
    }
    kept
}

pub(super) const WEIGHTS: &str = "--lpips-weights";

/// Flags of `centaur train` that every job sets itself.
pub(super) const OF_JOBS: [&str; 9] =
    ["-o", "--output", "--ply", "--report", "--seed", "--json", "--quiet", "-q", "--resume"];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flags_that_the_command_gives_are_none_of_a_scene() {
        let words = |text: &str| text.split(' ').map(str::to_owned).collect::<Vec<_>>();
        let of_scene = "--iterations 2 --lambda=-1 --masks --warmup -1 --downscale 2";
        let left = |others: &str| left_of(&words(of_scene), &words(others)).join(" ");
        assert_eq!(left("--iterations=3"), "--lambda=-1 --masks --warmup -1 --downscale 2");
        assert_eq!(left("--warmup 5 --masks"), "--iterations 2 --lambda=-1 --downscale 2");
        assert_eq!(left("--max-side 64"), "--iterations 2 --lambda=-1 --masks --warmup -1");
        assert_eq!(left("--layers 2"), of_scene);
    }
}
