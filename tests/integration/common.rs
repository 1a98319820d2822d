//! Shared parts of the tests of the program: a tiny capture, and running the program as a user would.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use glam::{DMat3, DQuat, DVec3};
use image::{Rgb, RgbImage};

/// The program, ready to run in `folder`.
pub(crate) fn centaur(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_centaur"));
    // Mesa prints warnings if this is not set.
    command.current_dir(folder).env("XDG_RUNTIME_DIR", std::env::temp_dir());
    command
}

/// The small capture of the repository.
pub(crate) fn demo() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("demo")
}

/// A file or folder of the shared data, whose root is in `CENTAUR_DATA`.
pub(crate) fn data(path: &str) -> PathBuf {
    let root = std::env::var_os("CENTAUR_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    // Programs run in other folders.
    std::path::absolute(root.join(path)).unwrap()
}

/// Sends a signal to a process with the shell's built-in `kill`: the program is missing on small systems.
#[cfg(unix)]
pub(crate) fn send(signal: &str, process: &str) {
    let sent = Command::new("sh").args(["-c", &format!("kill -{signal} {process}")]).status();
    assert!(sent.unwrap().success(), "{signal} to {process}");
}

pub(crate) fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

/// Output of a command: results, followed by notes.
pub(crate) fn said(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap() + &stderr(output)
}

/// Files and folders below `folder`, sorted.
pub(crate) fn tree(folder: &Path) -> Vec<String> {
    let mut found = vec![];
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        found.push(path.display().to_string());
        if path.is_dir() {
            found.extend(tree(&path));
        }
    }
    found.sort();
    found
}

/// Runs a command that must fail with one line on stderr and leave the folder unchanged; returns the line.
pub(crate) fn failure(folder: &Path, command: &mut Command) -> String {
    refusal(folder, command, 1)
}

/// [`failure`] for a command with wrong usage.
pub(crate) fn wrong_usage(folder: &Path, command: &mut Command) -> String {
    refusal(folder, command, 2)
}

fn refusal(folder: &Path, command: &mut Command, code: i32) -> String {
    let before = tree(folder);
    let output = command.output().unwrap();
    let text = if cfg!(windows) { as_on_unix(&stderr(&output)) } else { stderr(&output) };
    assert_eq!(output.status.code(), Some(code), "{command:?}: {text}");
    let is_one_line = text.starts_with("error: ") && text.lines().count() == 1;
    assert!(output.stdout.is_empty() && is_one_line, "{command:?}: {text}");
    assert_eq!(tree(folder), before, "{command:?} left something behind");
    text.trim_end().to_owned()
}

/// Messages of Windows, with the separators of Unix in paths and its words for files and folders that are not there.
fn as_on_unix(text: &str) -> String {
    let words = |code| std::io::Error::from_raw_os_error(code).to_string().replace(&format!(" (os error {code})"), "");
    [2, 3]
        .map(words)
        .iter()
        .fold(text.replace('\\', "/"), |text, words| text.replace(words, "No such file or directory"))
}

/// Writes a COLMAP text model of `count` cameras that look at a ball of coloured points from all around, with pictures.
pub(crate) fn write_capture(root: &Path, count: usize, (width, height): (u32, u32)) {
    const COLORS: [[u8; 3]; 3] = [[230, 60, 40], [40, 190, 90], [60, 90, 220]];
    let sparse = root.join("sparse/0");
    std::fs::create_dir_all(&sparse).unwrap();
    std::fs::create_dir_all(root.join("images")).unwrap();
    let focal = f64::from(width);
    let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
    std::fs::write(sparse.join("cameras.txt"), format!("1 PINHOLE {width} {height} {focal} {focal} {cx} {cy}\n"))
        .unwrap();
    // A Fibonacci sphere of radius 0.4.
    let points: Vec<DVec3> = (0..300)
        .map(|i| {
            let z = 1.0 - 2.0 * (f64::from(i) + 0.5) / 300.0;
            let (r, angle) = ((1.0 - z * z).sqrt(), 2.399_963 * f64::from(i));
            0.4 * DVec3::new(r * angle.cos(), r * angle.sin(), z)
        })
        .collect();
    let mut lines = String::new();
    for (i, p) in points.iter().enumerate() {
        let [r, g, b] = COLORS[i % 3];
        writeln!(lines, "{} {} {} {} {r} {g} {b} 0.1 1 0", i + 1, p.x, p.y, p.z).unwrap();
    }
    std::fs::write(sparse.join("points3D.txt"), lines).unwrap();
    let mut lines = String::new();
    for view in 0..count {
        let angle = std::f64::consts::TAU * view as f64 / count as f64;
        let rotation = DMat3::from_rotation_y(angle);
        let translation = DVec3::new(0.0, 0.0, 1.5);
        let q = DQuat::from_mat3(&rotation);
        let [x, y, z] = translation.to_array();
        writeln!(lines, "{} {} {} {} {} {x} {y} {z} 1 {view:03}.png\n", view + 1, q.w, q.x, q.y, q.z).unwrap();
        let mut picture = RgbImage::from_pixel(width, height, Rgb([20, 20, 30]));
        // Distant points first, so that near ones cover them.
        let mut seen: Vec<(DVec3, usize)> =
            points.iter().enumerate().map(|(i, &p)| (rotation * p + translation, i)).collect();
        seen.sort_by(|a, b| b.0.z.total_cmp(&a.0.z));
        for (p, i) in seen {
            let (u, v) = ((focal * p.x / p.z + cx) as u32, (focal * p.y / p.z + cy) as u32);
            for (u, v) in [(u, v), (u + 1, v), (u, v + 1), (u + 1, v + 1)] {
                if u < width && v < height {
                    picture.put_pixel(u, v, Rgb(COLORS[i % 3]));
                }
            }
        }
        picture.save(root.join(format!("images/{view:03}.png"))).unwrap();
    }
    std::fs::write(sparse.join("images.txt"), lines).unwrap();
}
