use std::path::PathBuf;

use anyhow::{Result, bail};
use centaur::format;

use super::output;

const EXAMPLES: &str = "\
Examples:
  centaur validate garden.glb
  centaur validate point_cloud.ply --json

The exit code is 1 if there are errors; it is 0 if there are only warnings.";

/// List every fault of a scene file: structure, values, rules of the splat extensions
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// Scene file: .glb, .gltf, .ply, .spz, .usda, .usdc or .usdz, or any other file that `centaur convert` reads
    ///
    /// Of USD files, the arrays, extents and maps are checked; of other files, whether they can be read.
    file: PathBuf,
    /// Print one JSON object, with severity, code, location (JSON pointer or byte), expected and found for each finding
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Result<()> {
    let validation = format::validate(&args.file)?;
    let printed = if args.json {
        output::print_json(&validation)
    } else {
        output::print_lines(validation.to_string().split('\n'))
    };
    // Also if nobody reads the output to its end.
    if validation.errors > 0 {
        bail!("{}: {} error(s)", args.file.display(), validation.errors);
    }
    printed
}
