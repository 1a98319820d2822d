//! What all targets do: put the bytes into a file in memory, and read it in every way in which the program would. Also a module of
//! `tests/damaged_files.rs`, so that it is compiled and run where nobody fuzzes.
//! That a file is refused is fine; a panic, a hang, or memory beyond the limits of `make fuzz` is a finding.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use centaur::format::{self, ReadOptions, Sampling};
use tempfile::TempDir;

/// A folder of this process, in memory where the system has such a place.
fn folder() -> &'static Path {
    static FOLDER: OnceLock<TempDir> = OnceLock::new();
    let made = || {
        let memory = Path::new("/dev/shm");
        if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() }.expect("a temporary folder")
    };
    FOLDER.get_or_init(made).path()
}

fn put(name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder().join(name);
    std::fs::write(&path, bytes).expect("a file in a temporary folder");
    path
}

/// A scene: read strictly and leniently, summed up, checked; its cameras by themselves.
pub fn splats(name: &str, bytes: &[u8]) {
    let path = put(name, bytes);
    let strict = format::read_file(&path, &ReadOptions::default());
    let options = ReadOptions { drop_invalid: true, keep_document: true, ..ReadOptions::default() };
    let lenient = format::read_file(&path, &options);
    assert!(strict.is_err() || lenient.is_ok(), "refused when invalid splats may be dropped, but not otherwise");
    let _ = format::read_file(&path, &ReadOptions { time: Some(0.3), ..ReadOptions::default() });
    let _ = format::inspect(&path);
    let _ = format::validate(&path);
    let _ = format::read_cameras(&path, &Sampling::default());
}

/// A mesh alone.
pub fn mesh(name: &str, bytes: &[u8]) {
    let _ = format::mesh_import::read(&put(name, bytes));
}

/// A glTF, which may be both.
pub fn scene_and_mesh(name: &str, bytes: &[u8]) {
    splats(name, bytes);
    mesh(name, bytes);
}

/// A grey photograph of 1×1.
const PHOTOGRAPH: &[u8] = b"\x89PNG\x0d\x0a\x1a\x0a\x00\x00\x00\x0dIHDR\x00\x00\x00\x01\x00\x00\x00\x01\x08\x00\x00\x00\x00:~\x9bU\x00\x00\x00\x0aIDATx\xdach\x00\x00\x00\x82\x00\x81\xdaE\x08;\x00\x00\x00\x00IEND\xaeB`\x82";

/// A capture of photographs `a.png` and `b.png`. The bytes are the files one after the other, each but the last preceded by its length
/// in two bytes.
pub fn capture<const N: usize>(names: [&str; N], bytes: &[u8]) {
    let mut rest = bytes;
    for (i, name) in names.into_iter().enumerate() {
        let mut own = rest;
        if i + 1 < N {
            let Some((length, after)) = rest.split_first_chunk() else { return };
            let length = usize::from(u16::from_le_bytes(*length)).min(after.len());
            (own, rest) = after.split_at(length);
        }
        put(name, own);
    }
    static PHOTOGRAPHS: OnceLock<()> = OnceLock::new();
    PHOTOGRAPHS.get_or_init(|| {
        let images = folder().join("images");
        std::fs::create_dir(&images).expect("a folder in a temporary folder");
        for name in ["a.png", "b.png"] {
            std::fs::write(images.join(name), PHOTOGRAPH).expect("a file in a temporary folder");
        }
    });
    let _ = centaur::capture::open(folder(), &Default::default());
    let _ = centaur::capture::cameras(folder(), &Default::default());
}

/// A checkpoint.
pub fn checkpoint(bytes: &[u8]) {
    let _ = centaur::optimize::checkpoint::Checkpoint::read(&put("scene.checkpoint", bytes));
}
