//! One file per subcommand. Exit codes: 0 done, 1 failure, which the last line on stderr tells, 2 wrong usage, 3 jobs
//! of `bench` that another runner is at, 128 + n stopped by signal n.

mod bench;
mod cameras;
mod convert;
mod devices;
mod edits;
mod eval;
#[cfg(test)]
mod flag_tests;
mod history;
mod inspect;
mod interrupt;
mod mesh;
mod output;
mod progress;
mod render;
mod shared;
mod shell;
mod train;
mod usage;
mod validate;
mod video;

use std::ffi::OsString;
use std::io::{self, Write as _};
use std::process::ExitCode;

use anyhow::{Context as _, Result};
use centaur::format::{self, FormatError};
use clap::{CommandFactory as _, FromArgMatches as _, Parser, Subcommand};

const FIRST_STEPS: &str = "\
First steps:
  centaur devices                                       # list the GPUs that are found
  centaur train CAPTURE -o scene.glb --report report    # photographs to a scene, with scores
  centaur render scene.glb -o frames                    # images of the scene
  centaur convert scene.glb scene.ply --no-mesh         # its splats, for other programs

Exit codes: 0 success, 1 failure (the last line on stderr begins with `error:` and gives the reason), 2 wrong usage, 3 jobs of `bench` that another runner is still working on, 130 stopped by Ctrl-C (129 by SIGHUP, 143 by SIGTERM; a stopped training has saved a checkpoint or its scene; on Windows, closing the window saves neither).";

/// Train, score, render and convert hybrid scenes: textured, semi-transparent meshes and 3D Gaussian splats, blended in
/// one depth order.
#[derive(Parser)]
#[command(name = "centaur", bin_name = "centaur", version, arg_required_else_help = true, max_term_width = 100)]
#[command(after_help = FIRST_STEPS)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Train(Box<train::Args>),
    Eval(eval::Args),
    Render(render::Args),
    Cameras(Box<cameras::Args>),
    Convert(Box<convert::Args>),
    Inspect(inspect::Args),
    Validate(validate::Args),
    Mesh(mesh::Args),
    Bench(Box<bench::Args>),
    Devices(devices::Args),
}

impl Cli {
    /// The arguments, of which the first is the program.
    fn of(arguments: impl IntoIterator<Item = OsString>) -> Result<Self, clap::Error> {
        let mut command = with_numbers_below_zero(Self::command());
        let matches = command.try_get_matches_from_mut(arguments)?;
        Self::from_arg_matches(&matches).map_err(|e| e.format(&mut command))
    }
}

/// Numbers below zero are values of every option, whose parser says what it takes, and no flags that nobody has given.
fn with_numbers_below_zero(command: clap::Command) -> clap::Command {
    let command = command.mut_args(|arg| {
        let takes_one = !arg.is_positional() && arg.get_action().takes_values();
        if takes_one { arg.allow_negative_numbers(true) } else { arg }
    });
    command.mut_subcommands(with_numbers_below_zero)
}

impl Command {
    fn run(&self) -> Result<()> {
        match self {
            Self::Train(args) => train::run(args),
            Self::Eval(args) => eval::run(args),
            Self::Render(args) => render::run(args),
            Self::Cameras(args) => cameras::run(args),
            Self::Convert(args) => convert::run(args),
            Self::Inspect(args) => inspect::run(args),
            Self::Validate(args) => validate::run(args),
            Self::Mesh(args) => mesh::run(args),
            Self::Bench(args) => bench::run(args),
            Self::Devices(args) => devices::run(args),
        }
    }
}

/// Exit code of wrong usage, the same as clap's.
const WRONG_USAGE: u8 = 2;

/// Exit code where jobs of `centaur bench` are another runner's: to whoever runs it no failure, but a reason to ask
/// again.
const LEFT_TO_ANOTHER: u8 = 3;

pub(crate) fn main() -> ExitCode {
    // What clap knows to be wrong usage ends here with exit code 2.
    let command = Cli::of(std::env::args_os()).unwrap_or_else(|e| e.exit()).command;
    let result = names_for_json(std::env::args_os())
        .and_then(|()| interrupt::handle())
        .and_then(|()| start_threads())
        .and_then(|()| command.run());
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) if output::is_read_enough(&e) => ExitCode::SUCCESS,
        Err(e) => {
            if let Some(stopped) = e.downcast_ref::<interrupt::Stopped>() {
                return ExitCode::from(stopped.exit_code);
            }
            // Nothing is left to be done if stderr is gone too.
            let _ = writeln!(io::stderr(), "error: {}{}", one_line(&e), advice(&e));
            if usage::is_wrong(&e) {
                ExitCode::from(WRONG_USAGE)
            } else if bench::is_left_to_another(&e) {
                ExitCode::from(LEFT_TO_ANOTHER)
            } else {
                ExitCode::FAILURE
            }
        }
    }
}

/// Starts rayon's threads now, because rayon panics if it cannot start them on first use: containers may have more
/// cores than permitted threads.
fn start_threads() -> Result<()> {
    rayon::ThreadPoolBuilder::new()
        .build_global()
        .context("cannot start a thread for every core; RAYON_NUM_THREADS=4, say, in the environment takes fewer")
}

/// Rejects names that are not UTF-8 with `--json`, which cannot represent them, before anything is done.
fn names_for_json(arguments: impl IntoIterator<Item = OsString>) -> Result<()> {
    let arguments: Vec<OsString> = arguments.into_iter().collect();
    let is_asked_for = arguments.iter().any(|argument| argument == "--json");
    match arguments.iter().find(|argument| is_asked_for && argument.to_str().is_none()) {
        Some(name) => Err(usage::wrong(format!("--json: expected names in UTF-8, found {}", name.display()))),
        None => Ok(()),
    }
}

/// Chain of causes, outermost first, on one line. A cause that its effect already quotes is not repeated.
fn one_line(error: &anyhow::Error) -> String {
    let mut line = String::new();
    for cause in error.chain() {
        let cause = cause.to_string().split_whitespace().collect::<Vec<_>>().join(" ");
        // Names may contain any character.
        let cause = output::without_codes(&format::one_line(&cause)).into_owned();
        if line.is_empty() {
            line = cause;
        } else if !line.contains(&cause) {
            line = format!("{line}: {cause}");
        }
    }
    line
}

/// What follows an error that does not say which rule a file breaks: the command that does.
fn advice(error: &anyhow::Error) -> String {
    let invalid = error.chain().find_map(|cause| cause.downcast_ref::<FormatError>()?.invalid_gltf());
    let command = invalid.map(|file| format!("; `centaur validate {}` says more", shell::argument(file)));
    command.map_or_else(String::new, |command| format::one_line(&command).into_owned())
}

#[cfg(test)]
mod tests {
    use anyhow::anyhow;
    use clap::error::ErrorKind;

    use super::*;

    #[test]
    fn arguments_are_consistent() {
        with_numbers_below_zero(Cli::command()).debug_assert();
    }

    #[test]
    fn numbers_below_zero_are_told_what_is_taken() {
        for (words, said) in [
            ("cameras orbit a -o b.glb --frames -3", "-3 is not in 1..=36000"),
            ("train a -o b.glb --iterations -5", "-5 is not in 1.."),
            ("train a -o b.glb --iterations 0", "0 is not in 1.."),
            ("train a -o b.glb --seed -1", "expected a whole number from 0"),
            ("bench a -o b --seeds -1", "expected a whole number from 0"),
            ("mesh a -o b.glb --truth c --within -1", "expected a number above 0"),
            ("convert a.ply b.ply --decimate -2", "expected a number of splats"),
        ] {
            let error = Cli::of(["centaur"].into_iter().chain(words.split(' ')).map(OsString::from)).err().unwrap();
            assert!(error.exit_code() == 2 && error.to_string().contains(said), "{words}: {error}");
        }
    }

    /// Words of a command and of all its subcommands, such as `centaur cameras orbit`.
    fn commands(command: &clap::Command, above: &[String]) -> Vec<Vec<String>> {
        let words = [above, &[command.get_name().to_owned()]].concat();
        let below = command.get_subcommands().flat_map(|command| commands(command, &words));
        std::iter::once(words.clone()).chain(below).collect()
    }

    #[test]
    fn help_is_an_answer_of_every_command() {
        let all = commands(&Cli::command(), &[]);
        assert!(
            ["bench", "devices", "orbit"].iter().all(|name| all.iter().any(|words| words.ends_with(&[(*name).into()])))
        );
        for words in all {
            let help = Cli::try_parse_from(words.iter().map(String::as_str).chain(["--help"])).err().unwrap();
            assert_eq!(
                (help.kind(), help.exit_code(), help.use_stderr()),
                (ErrorKind::DisplayHelp, 0, false),
                "{words:?}"
            );
            assert!(help.to_string().contains(&format!("Usage: {}", words.join(" "))), "{words:?}: {help}");
        }
    }

    /// Wrapped examples cannot be pasted, and wrapped tables are hard to read.
    #[test]
    fn what_follows_the_options_fits_the_terminal() {
        for command in Cli::command().get_subcommands() {
            let after = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            let longest = after.lines().map(|line| line.chars().count()).max().unwrap_or(0);
            assert!(longest <= 100, "{}: {longest}", command.get_name());
        }
    }

    #[test]
    fn causes_are_joined_once_each_on_one_line() {
        let error = anyhow!("no such file").context("a.bin: no such file").context("reading\nthe capture");
        assert_eq!(one_line(&error), "reading the capture: a.bin: no such file");
        let advice = anyhow!("no surface").context("making the mesh: no surface; --no-mesh does without");
        assert_eq!(one_line(&advice), "making the mesh: no surface; --no-mesh does without");
        let missing = anyhow::Error::new(io::Error::from_raw_os_error(2)).context("a.bin");
        assert!(!one_line(&missing).contains("os error"), "{}", one_line(&missing));
        assert_eq!(one_line(&anyhow!("a\u{1b}[2J\nb.bin: no such file")), "a\\u{1b}[2J b.bin: no such file");
    }
}
