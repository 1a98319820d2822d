//! What commands print.

use std::io::{self, Write as _};

use anyhow::Result;

/// Prints one JSON object on a line of stdout.
pub(super) fn print_json(value: &impl serde::Serialize) -> Result<()> {
    print(&serde_json::to_string(value)?)
}

/// Prints `text` and a line end on stdout.
pub(super) fn print(text: &str) -> Result<()> {
    Ok(writeln!(io::stdout().lock(), "{text}")?)
}
