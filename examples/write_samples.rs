//! Writes the initial corpus for fuzzing: `cargo run --release --example write_samples -- fuzz/corpus`.
//!
//! Creates a folder per target. The files of a capture are concatenated, each but the last preceded by its length in
//! two bytes.

use std::error::Error;
use std::path::Path;

#[path = "../tests/samples/mod.rs"]
mod samples;

fn main() -> Result<(), Box<dyn Error>> {
    let root = std::env::args().nth(1).ok_or("usage: write_samples FOLDER")?;
    for (i, sample) in samples::samples().into_iter().enumerate() {
        let folder = Path::new(&root).join(sample.reader);
        std::fs::create_dir_all(&folder)?;
        let mut bytes = vec![];
        let last = sample.files.len() - 1;
        for (k, (_, content)) in sample.files.into_iter().enumerate() {
            if k < last {
                bytes.extend(u16::try_from(content.len())?.to_le_bytes());
            }
            bytes.extend(content);
        }
        std::fs::write(folder.join(format!("sample-{i}")), bytes)?;
    }
    Ok(())
}
