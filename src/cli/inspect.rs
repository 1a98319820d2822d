use std::path::PathBuf;

use anyhow::Result;
use centaur::format;

use super::output;

const EXAMPLES: &str = "\
Examples:
  centaur inspect garden.glb
  centaur inspect point_cloud.ply --json";

/// Show the content of a scene file: splats, meshes, maps, cameras, blending rule, bytes; for glTF also the tree of
/// nodes
///
/// Coordinates are y-down, as in the crop options of `centaur convert`; in glTF and USD files, y and z have the
/// opposite sign.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// Scene file: .glb, .gltf, .usda, .usdc or .usdz, any .ply, or splats: .spz, .sog (or the meta.json of a SOG
    /// folder), .splat, .ksplat
    file: PathBuf,
    /// Print one JSON object instead of text
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Result<()> {
    let summary = format::inspect(&args.file)?;
    if args.json {
        output::print_json(&summary)
    } else {
        output::print_lines(summary.to_string().trim_end().split('\n'))
    }
}
