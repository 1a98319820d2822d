//! The `centaur` command: parses arguments, calls the library, prints.

#![cfg_attr(test, allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test"))]

mod cli;

fn main() -> std::process::ExitCode {
    cli::main()
}
