use std::path::PathBuf;

use anyhow::Result;
use centaur::format;

use super::output;

const EXAMPLES: &str = "\
Examples:
  centaur inspect garden.glb
  centaur inspect point_cloud.ply --json";

/// Say what is in a scene file: splats, meshes, maps, cameras, rule of blending, bytes; of a glTF the tree of nodes
///
/// Coordinates are y-down, as for the crops of `centaur convert`; glTF and USD have y and z with the other sign.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// A .glb, .gltf, .usda, .usdc or .usdz, any .ply, or splats: .spz, .sog (or a SOG folder's meta.json), .splat, .ksplat
    file: PathBuf,
    /// Print one JSON object instead of text
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Result<()> {
    let summary = format::inspect(&args.file)?;
    if args.json { output::print_json(&summary) } else { output::print(summary.to_string().trim_end()) }
}
