//! Benchmark of a data set: its captures are trained and scored as independent jobs, on this machine or by any
//! scheduler, with one table of results.

#[cfg(test)]
mod flag_tests;
mod flags;
mod jobs;
mod protocol;
mod published;
mod record;
mod scenes;
mod table;
mod work;

use std::path::PathBuf;

use anyhow::{Result, bail, ensure};
use centaur::format::atomic_write;
use centaur::render::gpu::{GpuError, survey_adapters};

use self::jobs::{Job, Shard, Variant};
use self::protocol::Protocol;
use self::record::Record;
use self::work::Outcome;
use super::shared::MessageArgs;
use super::{interrupt, output, shell};

const EXAMPLES: &str = "\
Examples:
  centaur bench captures/mipnerf360 -o m360 --protocol b --variant hybrid --variant splats=--no-mesh
  centaur bench captures/mipnerf360 -o 7k --protocol b --scenes room --jobs 2 -- --iterations 7000
  centaur bench captures/mipnerf360 -o m360 --table

Several runners (processes, on one or more machines) share the jobs if all get the same arguments:
  JOBS=\"captures/mipnerf360 -o m360 --protocol b --variant hybrid --variant splats=--no-mesh\"
  CENTAUR_ADAPTER='#0' centaur bench $JOBS --shard 0/2  # on the first of 2 GPUs
  CENTAUR_ADAPTER='#1' centaur bench $JOBS --shard 1/2  # on the second, at the same time
  sbatch --array=0-17 datasets-scripts/bench.sbatch $JOBS  # Slurm, with centaur in the PATH
  python3 datasets-scripts/bench_ray.py $JOBS  # Ray, with centaur in the PATH
  centaur bench $JOBS --list | tr '\\n' '\\0' | xargs -0 -n 1 -P 4 sh -c

DATASET/scenes.json, with folders below DATASET and, if wanted, flags of `centaur train`:
  {\"scenes\": {\"Barn\": {\"capture\": \"more/Barn\", \"flags\": [\"--downscale\", \"2\"]},
              \"truck\": {\"capture\": \"tandt/truck\"}}}";

/// Train and score every capture of a data set, and compare the results with published ones
///
/// Every folder in DATASET that contains a capture is a scene; if DATASET has a scenes.json, the scenes are those that
/// it lists (see below), with flags of their own. Every combination of scene, variant and seed is a job. Its result is
/// written to OUT/VARIANT/SCENE-SEED.json when it is done. Jobs that have a result, or that another runner is working
/// on, are skipped; results of other flags, or of another capture of the same name, are refused. Ctrl-C leaves
/// checkpoints, from which the same command continues.
///
/// OUT/table.md lists all results in OUT and their means over the scenes that all variants have in common. If these
/// scenes are a known set, published results are added: Mip-NeRF 360 with either protocol; train and truck of Tanks and
/// Temples, or drjohnson and playroom of Deep Blending, at the image size as distributed; Barn, Caterpillar, Ignatius,
/// train and truck at about that size, which may be the five scenes of the paper of HERA. The latter three are not
/// compared with protocol a, which defines SSIM differently.
///
/// Below the table are the conditions of the scores, and notes of the trainings, such as why a scene has no mesh.
/// Scenes scored with masks are marked; they are neither averaged with others nor compared with published results.
/// Training times are of the whole training; times per iteration are of iterations that train splats and mesh (if there
/// is one) together.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// Folder of captures, such as datasets-scripts/fetch_captures.py makes
    dataset: PathBuf,
    /// Folder for scenes, reports and the table
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,
    /// Scenes to train, separated by commas [default: all]
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    scenes: Vec<String>,
    /// Training variant: a name, and flags of `centaur train`, which override those after `--`; may be given several
    /// times [default: `default`, without flags]
    #[arg(long = "variant", value_name = "NAME[=FLAGS]", value_parser = jobs::variant, allow_hyphen_values = true)]
    variants: Vec<Variant>,
    /// Seeds with which every scene and variant is trained, separated by commas
    #[arg(long, value_name = "N,N…", value_delimiter = ',', default_value = "0", value_parser = output::whole_number)]
    seeds: Vec<u64>,
    /// Image size for scenes of Mip-NeRF 360: 1/4 outdoors, 1/2 indoors; scenes with other names are used as they are
    /// [default: all scenes are]
    #[arg(long, value_enum)]
    protocol: Option<Protocol>,
    /// Number of jobs to run at the same time
    ///
    /// The table leaves out times of jobs that may have shared the machine, that is with --jobs above 1, --list or
    /// --shard. Runners that are started side by side by hand are not noticed.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    jobs: u16,
    /// Run only every N-th job, starting with job I (counted from 0), for Slurm arrays
    #[arg(long, value_name = "I/N", value_parser = jobs::shard)]
    shard: Option<Shard>,
    /// Wait up to this long for jobs of other runners, after all other jobs, and do those that are left undone
    ///
    /// With --wait, --shard or --only, the exit code is 3 if another runner is still working on one of these jobs at
    /// the end.
    #[arg(long, value_name = "SECONDS", default_value_t = 0)]
    wait: u64,
    /// Run only this job; may be given several times
    #[arg(long, value_name = "VARIANT/SCENE-SEED")]
    only: Vec<String>,
    /// Other runners may be on this machine: in what `--list` prints
    #[arg(long, hide = true)]
    beside_others: bool,
    /// Print a command, quoted for a shell, for each job that is not done, and run none
    #[arg(long, conflicts_with_all = ["table", "json"])]
    list: bool,
    /// Write the table of all results in -o, of whichever scenes and variants, and do nothing else
    #[arg(long)]
    table: bool,
    /// Flags of `centaur train` for all jobs
    #[arg(last = true, value_name = "FLAGS")]
    flags: Vec<String>,
    #[command(flatten)]
    messages: MessageArgs,
}

impl Args {
    /// Whether other runners may use this machine.
    fn shares_machine(&self) -> bool {
        self.beside_others || self.shard.is_some()
    }

    /// Tells a note at once.
    fn say(&self, text: &str) {
        output::say(text, self.messages.json);
    }

    /// Whether whoever runs this has to know what is left to another runner, as schedulers that make the table when all
    /// is done.
    fn wants_all(&self) -> bool {
        self.shard.is_some() || !self.only.is_empty() || self.wait > 0
    }
}

/// Jobs that another runner is at, which may do them yet.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct LeftToAnother(String);

/// Whether an error is that, which has an exit code of its own.
pub(super) fn is_left_to_another(error: &anyhow::Error) -> bool {
    error.is::<LeftToAnother>()
}

pub(super) fn run(args: &Args) -> Result<()> {
    if !args.list {
        output::check_folder(&args.output)?;
    }
    let before = record::all(&args.output)?;
    if args.table {
        ensure!(!before.is_empty(), "{}: expected results of jobs, found none", args.output.display());
        if args.protocol.is_some() {
            record::check_protocol(&before, args.protocol)?;
        }
        return print_table(args, &write_table(args, &before)?);
    }
    let all = jobs::all(args)?;
    let mine = jobs::chosen(&all, args)?;
    record::check(&before, &all)?;
    let is_done = |job: &Job| before.iter().any(|record| record.file == job.result);
    let mut open = vec![];
    for job in mine.into_iter().filter(|job| !is_done(job)) {
        if !job.result.exists() {
            open.push(job);
        } else if record::read(job.result.clone())?.is_none() {
            // Another runner may have written a result since.
            bail!("{}: not the result of a training; delete it to repeat the job", job.result.display());
        }
    }
    // Misspelt flags are reported now, not after hours.
    open.iter().try_for_each(|job| job.check())?;
    if args.list {
        return open.iter().try_for_each(|job| list(job, args));
    }
    // Each job would say so.
    if !open.is_empty() {
        let (adapters, unfit) = survey_adapters();
        ensure!(!adapters.is_empty(), GpuError::NoAdapter { unfit });
    }
    let _folder = output::Folder::make(&args.output)?;
    if !args.messages.quiet && !args.messages.json && !open.is_empty() && !open.iter().any(|job| job.scores_lpips()) {
        output::note("LPIPS will not be scored: that needs -- --lpips-weights FILE");
    }
    if let Some(note) = jobs::of_full_size(&open) {
        args.say(&note);
    }
    let Outcome { failed, left, is_stopped } = work::work(&open, args);
    let mut done = record::all(&args.output)?;
    // A shard may be empty and also be the first to run.
    let printed = if done.is_empty() {
        Ok(())
    } else {
        let mut table = write_table(args, &done)?;
        // If another runner has meanwhile written a table with more results, which this one has replaced, write it
        // again.
        let mut now = record::all(&args.output)?;
        while now.len() > done.len() {
            done = now;
            table = write_table(args, &done)?;
            now = record::all(&args.output)?;
        }
        print_table(args, &table)
    };
    // Even if nobody reads the table.
    if is_stopped {
        let names: Vec<String> = failed.iter().map(|(job, _)| job.name()).collect();
        let again = if names.is_empty() { "" } else { ", and repeats what failed: " };
        args.say(&format!("stopped; the same command goes on{again}{}", names.join(", ")));
        return interrupt::stopped(printed);
    }
    if let Some((job, reason)) = failed.first() {
        bail!("{} of {} jobs failed, first {}: {reason}", failed.len(), open.len(), job.name());
    }
    if let Some(job) = left.first() {
        let jobs = output::counted(left.len(), "job");
        let said = format!("{jobs} left to another runner, first {}", job.name());
        if args.wants_all() {
            return Err(LeftToAnother(format!("{said}: the same command does what that runner leaves undone")).into());
        }
        args.say(&said);
    }
    printed
}

fn write_table(args: &Args, done: &[Record]) -> Result<table::Table> {
    let table = table::Table::new(done, &args.output)?;
    atomic_write(&args.output.join("table.md"), table.to_string().as_bytes())?;
    atomic_write(&args.output.join("table.json"), &serde_json::to_vec_pretty(&table)?)?;
    Ok(table)
}

fn print_table(args: &Args, table: &table::Table) -> Result<()> {
    if args.messages.json {
        output::print_json(table)
    } else {
        output::print_lines(table.to_string().trim_end().split('\n'))
    }
}

/// Prints this command for a single job.
fn list(job: &Job, args: &Args) -> Result<()> {
    let program = std::env::args_os().next().unwrap_or_else(|| "centaur".into());
    let mut line = vec![];
    for word in std::iter::once(program).chain(job.listed(args)) {
        if !line.is_empty() {
            line.push(b' ');
        }
        line.extend(shell::quoted(&word, cfg!(windows)));
    }
    line.push(b'\n');
    output::write(&line)
}
