use std::path::PathBuf;

use anyhow::{Result, bail};
use centaur::format;

use super::output;

const EXAMPLES: &str = "\
Examples:
  centaur validate garden.glb
  centaur validate point_cloud.ply --json

Exit code 1 if there is an error; warnings alone leave it at 0.";

/// Say everything that is wrong with a scene file: structure, values, rules of the splat extensions
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// A .glb, .gltf, .ply or .spz; a .usda, .usdc or .usdz, whose arrays, extents and maps are looked at; of other files
    /// that `centaur convert` reads, whether they can be read
    file: PathBuf,
    /// Print one JSON object: severity, code, location (JSON pointer or byte), expected and found of each finding
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Result<()> {
    let validation = format::validate(&args.file)?;
    let printed = if args.json { output::print_json(&validation) } else { output::print(&validation.to_string()) };
    // Also if nobody reads the output to its end.
    if validation.errors > 0 {
        bail!("{}: {} error(s)", args.file.display(), validation.errors);
    }
    printed
}
