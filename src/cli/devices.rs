use anyhow::{Result, bail};
use centaur::render::gpu::{AdapterSummary, GpuError, survey_adapters};

use super::output;

const EXAMPLES: &str = "\
Examples:
  centaur devices
  centaur devices --json";

/// List the GPU adapters that can run Centaur, best first
///
/// Other commands use the first, or the one selected by `--adapter` or by the environment variable `CENTAUR_ADAPTER`:
/// an index (`#1`), a PCI bus id or any part of a name shown here.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// Print one JSON array of adapters instead of a table; if there are none, an empty array without an error
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Result<()> {
    let (adapters, unfit) = survey_adapters();
    if adapters.is_empty() && !args.json {
        bail!(GpuError::NoAdapter { unfit });
    }
    unfit.iter().for_each(|unfit| output::note(unfit));
    if args.json {
        return output::print_json(&adapters);
    }
    output::print_lines(adapters.iter().flat_map(describe))
}

/// Description in three lines: how to request the adapter, then what determines speed and capacity.
fn describe(a: &AdapterSummary) -> [String; 3] {
    let subgroups = match a.subgroup_size {
        (_, 0) => "no subgroups".to_owned(),
        (low, high) if low == high => format!("subgroups of {low}"),
        (low, high) => format!("subgroups of {low} to {high}"),
    };
    let timestamps = if a.timestamps { "timestamps" } else { "no timestamps" };
    [
        a.to_string(),
        format!("  {} {}, {}", a.backend, a.kind, a.driver),
        format!("  buffers up to {} MiB, {subgroups}, {timestamps}", a.max_binding_bytes >> 20),
    ]
}
