//! Every reader on random bytes and on valid files that were damaged: no panic, and no more memory than the file
//! justifies. `make fuzz` searches further.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

mod samples;

use std::path::Path;
use std::sync::{Mutex, PoisonError};

use centaur::capture::LoadOptions;
use centaur::format::{self, ReadOptions};
use centaur::optimize::checkpoint::Checkpoint;
use peak_alloc::PeakAlloc;
use proptest::prelude::*;
use samples::{PHOTOGRAPH, Sample, samples};

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// Memory is counted for the whole process, so that one test runs at a time.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

/// Bytes of memory per byte of a file at most. 5 kB of SOG hold 40 splats of 140 bytes in images of 100 kB, 30 bytes of a
/// PLY's header name a property in 100 bytes of memory.
const MOST_PER_BYTE: usize = 40;
/// Besides, for buffers, and for images of a size that small files may claim.
const MOST_BESIDES: usize = 16 << 20;

fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("images")).unwrap();
    for name in ["a.png", "b.png"] {
        std::fs::write(folder.path().join("images").join(name), PHOTOGRAPH).unwrap();
    }
    folder
}

/// Reads the files in every way in which the program would; whether any was taken.
fn read(folder: &Path, reader: &str, files: &[(&str, Vec<u8>)]) -> bool {
    for (name, content) in files {
        std::fs::write(folder.join(name), content).unwrap();
    }
    let path = folder.join(files[0].0);
    let before = MEMORY.current_usage();
    MEMORY.reset_peak_usage();
    let taken = match reader {
        "colmap_text" | "colmap_binary" | "transforms" => {
            centaur::capture::open(folder, &LoadOptions::default()).map_err(|e| e.to_string()).map(drop)
        }
        "checkpoint" => Checkpoint::read(&path).map_err(|e| e.to_string()).map(drop),
        "obj" | "mesh_ply" => format::mesh_import::read(&path).map_err(|e| e.to_string()).map(drop),
        _ => {
            let strict = format::read_file(&path, &ReadOptions::default());
            let lenient = format::read_file(&path, &ReadOptions { drop_invalid: true, keep_document: true });
            assert!(strict.is_err() || lenient.is_ok());
            let _ = (format::inspect(&path), format::validate(&path), format::mesh_import::read(&path));
            strict.map_err(|e| e.to_string()).map(drop)
        }
    };
    let peak = MEMORY.peak_usage().saturating_sub(before);
    let size: usize = files.iter().map(|(_, content)| content.len()).sum();
    assert!(peak <= MOST_PER_BYTE * size + MOST_BESIDES, "{reader}: {peak} bytes of memory for a file of {size}");
    if let Err(message) = &taken {
        // Whatever stands in the file, the message is one line that names it.
        assert!(!message.contains(['\n', '\r']) && message.len() < 600, "{message:?}");
        assert!(message.contains(&*folder.to_string_lossy()), "{message:?}");
    }
    taken.is_ok()
}

#[test]
fn the_samples_are_valid() {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    for Sample { reader, files } in samples() {
        assert!(read(folder().path(), reader, &files), "{reader}");
    }
}

/// One way to damage a file.
#[derive(Clone, Debug)]
enum Damage {
    Set(f64, u8),
    /// Four bytes at once: counts blown up.
    Word(f64, u32),
    Cut(f64),
    /// Some bytes are there twice.
    Repeat(f64, usize),
    /// A number in text made long.
    Digits(f64),
}

fn damage() -> impl Strategy<Value = Damage> {
    // Headers, where most of the damage is done, are at the beginning.
    let place = || prop_oneof![0.0..1.0, (0.0..1.0f64).prop_map(|x| x * x * x * x)];
    prop_oneof![
        4 => (place(), any::<u8>()).prop_map(|(at, byte)| Damage::Set(at, byte)),
        3 => (place(), prop_oneof![Just(u32::MAX), Just(1 << 31), Just(i32::MAX as u32), any::<u32>()])
            .prop_map(|(at, word)| Damage::Word(at, word)),
        1 => (0.0..1.0).prop_map(Damage::Cut),
        1 => (place(), 1usize..300).prop_map(|(at, count)| Damage::Repeat(at, count)),
        2 => place().prop_map(Damage::Digits),
    ]
}

fn apply(bytes: &mut Vec<u8>, damage: &Damage) {
    if bytes.is_empty() {
        return;
    }
    let place = |part: f64| ((bytes.len() as f64 * part) as usize).min(bytes.len() - 1);
    match *damage {
        Damage::Set(at, byte) => {
            let at = place(at);
            bytes[at] = byte;
        }
        Damage::Word(at, word) => {
            let at = place(at);
            bytes[at..].iter_mut().zip(word.to_le_bytes()).for_each(|(b, w)| *b = w);
        }
        Damage::Cut(at) => bytes.truncate(place(at)),
        Damage::Repeat(at, count) => {
            let at = place(at);
            let again = bytes[at..bytes.len().min(at + count)].to_vec();
            bytes.splice(at..at, again);
        }
        Damage::Digits(at) => {
            let start = place(at);
            if let Some(at) = bytes[start..].iter().position(u8::is_ascii_digit) {
                bytes.splice(start + at..start + at, *b"98765432109876543210");
            }
        }
    }
}

#[test]
fn damaged_files() {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = folder();
    for Sample { reader, files } in samples() {
        let sub = tempfile::tempdir_in(folder.path()).unwrap();
        std::fs::create_dir(sub.path().join("images")).unwrap();
        let strategy = (0..files.len(), proptest::collection::vec(damage(), 1..4));
        let mut runner = proptest::test_runner::TestRunner::new(ProptestConfig::with_cases(300));
        let outcome = runner.run(&strategy, |(which, damages)| {
            let mut damaged = files.clone();
            damages.iter().for_each(|d| apply(&mut damaged[which].1, d));
            read(sub.path(), reader, &damaged);
            Ok(())
        });
        assert!(outcome.is_ok(), "{reader}: {}", outcome.unwrap_err());
    }
}

#[test]
fn random_bytes() {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = folder();
    for Sample { reader, files } in samples() {
        let mut runner = proptest::test_runner::TestRunner::new(ProptestConfig::with_cases(60));
        // With and without the first bytes of the format, by which it is told.
        let strategy = (0..64usize, proptest::collection::vec(any::<u8>(), 0..300));
        let outcome = runner.run(&strategy, |(start, random)| {
            let begun = |content: &[u8]| [&content[..start.min(content.len())], &random].concat();
            let files: Vec<(&str, Vec<u8>)> = files.iter().map(|(name, c)| (*name, begun(c))).collect();
            read(folder.path(), reader, &files);
            Ok(())
        });
        assert!(outcome.is_ok(), "{reader}: {}", outcome.unwrap_err());
    }
}
