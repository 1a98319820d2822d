//! Work of all fuzz targets: each puts the bytes into a file in memory and reads it in every way in which the program
//! would. Also a module of `tests/damaged_files.rs`, so that it is compiled and run even where nobody fuzzes.
//!
//! An input may be refused; a panic, a hang, or memory use beyond the limits of `make fuzz` is a finding.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use centaur::capture::{self, CaptureError, Downscale, LoadOptions};
use centaur::format::{self, ReadOptions, Sampling};
use tempfile::TempDir;

/// Temporary folder of this process, in memory if the system has `/dev/shm`.
fn folder() -> &'static Path {
    static FOLDER: OnceLock<TempDir> = OnceLock::new();
    let made = || {
        let memory = Path::new("/dev/shm");
        if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() }.expect("a temporary folder")
    };
    FOLDER.get_or_init(made).path()
}

fn put(folder: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, bytes).expect("a file in a temporary folder");
    path
}

/// Splits concatenated files, each but the last preceded by its length in two bytes, and puts them into their own
/// folder.
fn unpacked(names: &[&str], bytes: &[u8]) -> Option<PathBuf> {
    let folder = folder().join(format!("with-{}", names[0]));
    std::fs::create_dir_all(&folder).expect("a folder in a temporary folder");
    unpack(&folder, names, bytes).then_some(folder)
}

/// Splits concatenated files into this folder; `false` if a length is missing.
fn unpack(folder: &Path, names: &[&str], bytes: &[u8]) -> bool {
    let Some((last, others)) = names.split_last() else { return false };
    let mut rest = bytes;
    for name in others {
        let Some((length, after)) = rest.split_first_chunk() else { return false };
        let (own, after) = after.split_at(usize::from(u16::from_le_bytes(*length)).min(after.len()));
        put(folder, name, own);
        rest = after;
    }
    put(folder, last, rest);
    true
}

fn read_scene(path: &Path) -> bool {
    let strict = format::read_file(path, &ReadOptions::default());
    let options = ReadOptions { drop_invalid: true, keep_document: true, ..ReadOptions::default() };
    let lenient = format::read_file(path, &options);
    assert!(strict.is_err() || lenient.is_ok(), "refused when invalid splats may be dropped, but not otherwise");
    let _ = format::read_file(path, &ReadOptions { time: Some(0.3), ..ReadOptions::default() });
    let _ = format::inspect(path);
    let _ = format::validate(path);
    let _ = format::read_cameras(path, &Sampling::default());
    strict.is_ok()
}

/// Reads a scene: strictly, leniently, at a point in time, inspected, validated, and its cameras by themselves. Like
/// the functions below, returns whether the input was accepted.
pub fn splats(name: &str, bytes: &[u8]) -> bool {
    read_scene(&put(folder(), name, bytes))
}

/// Reads a mesh alone.
pub fn mesh(name: &str, bytes: &[u8]) -> bool {
    format::mesh_import::read(&put(folder(), name, bytes)).is_ok()
}

/// Reads a glTF or USD, which can be a scene or a mesh.
pub fn scene_and_mesh(name: &str, bytes: &[u8]) -> bool {
    let is_scene = splats(name, bytes);
    mesh(name, bytes) || is_scene
}

/// Like [`scene_and_mesh`], for several files of which the first refers to the others.
pub fn scene_of_files(names: &[&str], bytes: &[u8]) -> bool {
    let Some(folder) = unpacked(names, bytes) else { return false };
    let path = folder.join(names[0]);
    let is_scene = read_scene(&path);
    format::mesh_import::read(&path).is_ok() || is_scene
}

/// A grey image of 1×1 pixels.
const PHOTOGRAPH: &[u8] = b"\x89PNG\x0d\x0a\x1a\x0a\x00\x00\x00\x0dIHDR\x00\x00\x00\x01\x00\x00\x00\x01\x08\x00\x00\x00\x00:~\x9bU\x00\x00\x00\x0aIDATx\xdach\x00\x00\x00\x82\x00\x81\xdaE\x08;\x00\x00\x00\x00IEND\xaeB`\x82";

/// Reads a capture with the photographs `a.png` and `b.png`.
pub fn capture(names: &[&str], bytes: &[u8]) -> bool {
    let Some(folder) = unpacked(names, bytes) else { return false };
    let images = folder.join("images");
    if !images.is_dir() {
        std::fs::create_dir(&images).expect("a folder in a temporary folder");
        for name in ["a.png", "b.png"] {
            put(&images, name, PHOTOGRAPH);
        }
    }
    let opened = capture::open(&folder, &LoadOptions::default()).is_ok();
    // The capture is also read for its cameras alone, without photographs.
    capture::cameras(&folder, &LoadOptions::default()).is_ok() || opened
}

/// Capture with a photograph `a.png` of any size, and a photograph `b.png` of 1×1 pixels.
const TWO_FRAMES: &str = r#"{"camera_angle_x":0.7,"k1":0.01,"frames":[
{"file_path":"images/a.png","transform_matrix":[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]},
{"file_path":"images/b.png","transform_matrix":[[0,0,1,4],[0,1,0,0],[-1,0,0,0],[0,0,0,1]]}]}"#;

/// Reads a photograph with its mask, and without a mask but downscaled.
pub fn decode(folder: &Path) -> [Result<(), CaptureError>; 2] {
    let masked = LoadOptions { masks: true, ..LoadOptions::default() };
    let smaller = LoadOptions { downscale: Downscale::Factor(2), ..LoadOptions::default() };
    [masked, smaller].map(|options| capture::decode(&capture::open(folder, &options)?.views[0]).map(drop))
}

/// Writes the capture `TWO_FRAMES` into a folder, except for `images/a.png` and `masks/a.png`.
pub fn prepare_for_photograph(folder: &Path) {
    for sub in ["images", "masks"] {
        let sub = folder.join(sub);
        std::fs::create_dir_all(&sub).expect("a folder in a temporary folder");
        put(&sub, "b.png", PHOTOGRAPH);
    }
    put(folder, "transforms.json", TWO_FRAMES.as_bytes());
}

/// Reads a photograph and its mask; the mask comes first, preceded by its length in two bytes.
pub fn photograph(names: &[&str], bytes: &[u8]) -> bool {
    // A byte of input may decode to 32,768 bytes, and take more memory after that: this bound stays within the limits
    // of `make fuzz`.
    if bytes.len() > 1500 {
        return false;
    }
    let capture = folder().join("photograph");
    if !capture.is_dir() {
        prepare_for_photograph(&capture);
    }
    unpack(&capture, names, bytes) && decode(&capture).iter().any(Result::is_ok)
}

/// Replaces the checksum of a checkpoint by the right one: with a wrong one nothing but the checksum would be tested.
pub fn mend_checksum(bytes: &mut [u8]) {
    if let Some((content, sum)) = bytes.split_last_chunk_mut() {
        let mut crc = flate2::Crc::new();
        crc.update(content);
        *sum = crc.sum().to_le_bytes();
    }
}

/// Reads a checkpoint.
pub fn checkpoint(bytes: &[u8]) -> bool {
    let mut bytes = bytes.to_vec();
    mend_checksum(&mut bytes);
    centaur::optimize::checkpoint::Checkpoint::read(&put(folder(), "scene.checkpoint", &bytes)).is_ok()
}
