//! A data set: its captures trained and scored as independent jobs, on this machine or by any scheduler, and one table.

mod jobs;
mod table;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use anyhow::{Context as _, Result, anyhow, bail, ensure};
use centaur::format::atomic_write;
use serde_json::Value;

use self::jobs::{Job, Protocol, Shard, Variant};
use super::output;
use super::shared::{self, MessageArgs};

const EXAMPLES: &str = "\
Examples:
  centaur bench data/mipnerf360 -o out/m360 --protocol b --variant hybrid --variant splats=--no-mesh
  centaur bench data/mipnerf360 -o out/m360 --scenes garden,room --jobs 2 -- --iterations 7000 --antialias
  centaur bench data/mipnerf360 -o out/m360 --table

Elsewhere, with the same DATASET and OUT:
  sbatch --array=0-8 --wrap 'centaur bench data/mipnerf360 -o out/m360 --shard $SLURM_ARRAY_TASK_ID/9'
  centaur bench data/mipnerf360 -o out/m360 --list | xargs -P 4 -I{} sh -c '{}'
  python datasets-scripts/bench_ray.py data/mipnerf360 -o out/m360        # on a Ray cluster";

/// Train and score every capture of a data set, and put the results beside published ones
///
/// Every folder in DATASET that holds a capture is a scene; every scene, variant and seed is a job of its own: OUT/VARIANT/SCENE-SEED.json is
/// there once it is done, and what is there is not done again. Ctrl-C leaves checkpoints, from which the same command goes on.
/// OUT/table.md has the scenes and their means, beside published rows where all scenes of a known set are there.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// Folder of captures, such as datasets-scripts/fetch_captures.py makes
    dataset: PathBuf,
    /// Folder for scenes, reports and the table
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,
    /// Only these scenes [default: all]
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    scenes: Vec<String>,
    /// A way to train, with flags of `centaur train`, which replace those after `--`; may be given several times [default: `default`, without flags]
    #[arg(long = "variant", value_name = "NAME[=FLAGS]", value_parser = jobs::variant, allow_hyphen_values = true)]
    variants: Vec<Variant>,
    /// Seeds of every scene and variant
    #[arg(long, value_name = "N,N…", value_delimiter = ',', default_value = "0")]
    seeds: Vec<u64>,
    /// Size of the pictures of Mip-NeRF 360, 1/4 outdoors and 1/2 indoors; scenes of other names are taken as they are
    #[arg(long, value_enum, default_value_t = Protocol::B)]
    protocol: Protocol,
    /// Jobs at a time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    jobs: u16,
    /// Only every N-th job, from the I-th on, counted from 0: for arrays of Slurm
    #[arg(long, value_name = "I/N", value_parser = jobs::shard)]
    shard: Option<Shard>,
    /// Only this job, as --list names it; may be given several times
    #[arg(long, value_name = "VARIANT/SCENE-SEED")]
    only: Vec<String>,
    /// Print a command for each job that is not done, and do none
    #[arg(long, conflicts_with = "table")]
    list: bool,
    /// Make the table of what is done, and do nothing else
    #[arg(long)]
    table: bool,
    /// Flags of `centaur train` for every job
    #[arg(last = true, value_name = "FLAGS")]
    flags: Vec<String>,
    #[command(flatten)]
    messages: MessageArgs,
}

pub(super) fn run(args: &Args) -> Result<()> {
    let all = jobs::all(args)?;
    let mine = jobs::chosen(&all, args)?;
    let open: Vec<&Job> = mine.into_iter().filter(|job| !job.result.is_file()).collect();
    if args.list {
        return list(&open);
    }
    if !args.table {
        // A misspelt flag is found now and not after hours.
        open.iter().try_for_each(|job| job.check())?;
        shared::make_folder(&args.output)?;
        let failed = work(&open, args)?;
        if let Some((job, reason)) = failed.first() {
            bail!("{} of {} jobs failed, first {}: {reason}", failed.len(), open.len(), job.name());
        }
    }
    let done = all.iter().filter_map(|job| read(&job.result).transpose().map(|value| value.map(|v| (job, v))));
    let done: Vec<(&Job, Value)> = done.collect::<Result<_>>()?;
    ensure!(!done.is_empty(), "{}: expected results of jobs, found none", args.output.display());
    let table = table::Table::new(&done, args.protocol);
    atomic_write(&args.output.join("table.md"), table.to_string().as_bytes())?;
    atomic_write(&args.output.join("table.json"), &serde_json::to_vec_pretty(&table)?)?;
    if args.messages.json { output::print_json(&table) } else { output::print(table.to_string().trim_end()) }
}

/// This command again, for one job each.
fn list(open: &[&Job]) -> Result<()> {
    let own: Vec<String> = std::env::args().collect();
    let (options, flags) = own.split_at(own.iter().position(|a| a == "--").unwrap_or(own.len()));
    for job in open {
        let mut command: Vec<&str> = options.iter().map(String::as_str).filter(|a| *a != "--list").collect();
        let name = job.name();
        command.extend(["--only", &name]);
        command.extend(flags.iter().map(String::as_str));
        output::print(&command.into_iter().map(quoted).collect::<Vec<_>>().join(" "))?;
    }
    Ok(())
}

/// For a shell.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,+@%".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', r"'\''"))
    }
}

/// Does the jobs and returns those that failed, with reasons.
fn work<'j>(open: &[&'j Job], args: &Args) -> Result<Vec<(&'j Job, String)>> {
    let stop = super::train::stop_on_ctrl_c()?;
    let bar = output::bar(&args.messages, open.len() as u64);
    bar.set_style(indicatif::ProgressStyle::with_template("{pos}/{len} jobs  {bar:16}  ETA {eta}  {wide_msg}")?);
    let (queue, failed) = (Mutex::new(open.iter()), Mutex::new(vec![]));
    let interrupted = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for _ in 0..args.jobs {
            scope.spawn(|| {
                while !stop.load(Ordering::Relaxed) {
                    let next = queue.lock().map_or(None, |mut queue| queue.next());
                    let Some(&job) = next else { break };
                    bar.set_message(job.name());
                    let start = Instant::now();
                    match train(job) {
                        Ok(true) => {
                            let minutes = start.elapsed().as_secs_f64() / 60.0;
                            bar.println(format!("{}: {minutes:.1} min", job.name()));
                        }
                        Ok(false) => interrupted.store(true, Ordering::Relaxed),
                        Err(reason) => {
                            bar.println(format!("{}: {reason:#}", job.name()));
                            if let Ok(mut failed) = failed.lock() {
                                failed.push((job, format!("{reason:#}")));
                            }
                        }
                    }
                    bar.inc(1);
                }
            });
        }
    });
    bar.finish_and_clear();
    if stop.load(Ordering::Relaxed) || interrupted.load(Ordering::Relaxed) {
        bail!("stopped; the same command goes on");
    }
    Ok(failed.into_inner().unwrap_or_default())
}

/// One training in a process of its own, whose memory is gone with it; false if it was interrupted.
fn train(job: &Job) -> Result<bool> {
    job.result
        .parent()
        .map_or(Ok(()), |folder| std::fs::create_dir_all(folder).with_context(|| folder.display().to_string()))?;
    let mut command = Command::new(std::env::current_exe().context("cannot find this program")?);
    command.args(job.command()).stdin(Stdio::null());
    let output = command.output().context("cannot start a training")?;
    let messages = String::from_utf8_lossy(&output.stderr);
    if !output.status.success() {
        let last = messages.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("no message");
        return Err(anyhow!("{}", last.trim_start_matches("error: ").to_owned()));
    }
    let result: Value = serde_json::from_slice(&output.stdout).context("a training printed no JSON")?;
    if result["outcome"] != "finished" {
        return Ok(false);
    }
    atomic_write(&job.result, &serde_json::to_vec_pretty(&result)?)?;
    Ok(true)
}

/// What a job left, if it is done.
fn read(result: &Path) -> Result<Option<Value>> {
    match std::fs::read(result) {
        Ok(bytes) => Ok(Some(serde_json::from_slice(&bytes).with_context(|| result.display().to_string())?)),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(e).with_context(|| result.display().to_string()),
    }
}
