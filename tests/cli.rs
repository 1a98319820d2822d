//! The command as a user meets it: exit codes, one clear line for every mistake, nothing left behind.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::process::{Command, Output};

fn centaur(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_centaur")).args(args).output().unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

#[test]
fn wrong_usage_is_exit_code_2() {
    for args in [&[][..], &["fly"], &["devices", "--fast"]] {
        let output = centaur(args);
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(output.stdout.is_empty() && stderr(&output).contains("Usage: centaur"), "{args:?}");
    }
}

#[test]
fn help_and_version_are_answers_not_errors() {
    for args in [&["--help"][..], &["--version"], &["devices", "--help"]] {
        let output = centaur(args);
        assert_eq!(output.status.code(), Some(0), "{args:?}");
        assert!(!output.stdout.is_empty() && output.stderr.is_empty(), "{args:?}");
    }
}

#[test]
fn devices_as_json_is_an_array_with_or_without_a_gpu() {
    let output = centaur(&["devices", "--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert!(serde_json::from_slice::<serde_json::Value>(&output.stdout).unwrap().is_array());
}
