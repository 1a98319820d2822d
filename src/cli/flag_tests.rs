//! Which flags a command has, and which options each of them sets.

use std::collections::BTreeMap;

use clap::CommandFactory as _;

use super::Cli;

/// Options of a command: values by name, as printed by `Debug`.
pub(super) type Options = BTreeMap<&'static str, String>;

/// Flags (after ` beside `, those that they require) and the options that they change.
pub(super) type Row = (&'static str, &'static [(&'static str, &'static str)]);

/// Asserts that the flags of every row change its options and no others, that every option is in a row, and that every
/// flag of the command is in a row or in `others`. `asked` parses flags.
pub(super) fn assert_flags(command: &str, rows: &[Row], others: &[&str], asked: impl Fn(&str) -> Options) {
    for &(flags, expected) in rows {
        let (flags, beside) = flags.split_once(" beside ").unwrap_or((flags, ""));
        let without = asked(beside);
        let with = asked(&format!("{beside} {flags}")).into_iter();
        let changed: Vec<(&str, String)> = with.filter(|(name, value)| without[name] != *value).collect();
        let expected: Vec<(&str, String)> = expected.iter().map(|(name, value)| (*name, (*value).to_owned())).collect();
        assert_eq!(changed, expected, "{command} {flags}");
    }
    for option in asked("").keys() {
        let is_set = rows.iter().any(|(_, options)| options.iter().any(|(name, _)| name == option));
        assert!(is_set, "{command}: {option} is set by no flag of this table");
    }
    let all = Cli::command();
    let found = command.split(' ').fold(&all, |of, name| of.find_subcommand(name).unwrap());
    let mut flags: Vec<&str> = found.get_arguments().filter_map(|flag| flag.get_long()).collect();
    // `--` itself has no name.
    let of_rows = rows.iter().map(|(flags, _)| flags[2..].split(' ').next().unwrap()).filter(|name| !name.is_empty());
    let mut known: Vec<&str> = of_rows.chain(others.iter().copied()).collect();
    flags.sort_unstable();
    known.sort_unstable();
    known.dedup();
    assert_eq!(flags, known, "{command}: a flag is in this table or among the others");
}
