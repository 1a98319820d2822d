use clap::Parser as _;

use crate::cli::flag_tests::{Options, Row, assert_flags};
use crate::cli::{Cli, Command};

/// Options of `centaur bench` with these flags.
fn asked(flags: &str) -> Options {
    let words = ["centaur", "bench", "captures", "-o", "out"].into_iter().chain(flags.split_whitespace());
    let Command::Bench(args) = Cli::try_parse_from(words).unwrap().command else { unreachable!() };
    [
        ("scenes", format!("{:?}", args.scenes)),
        ("variants", format!("{:?}", args.variants)),
        ("seeds", format!("{:?}", args.seeds)),
        ("protocol", format!("{:?}", args.protocol)),
        ("jobs", format!("{:?}", args.jobs)),
        ("shard", format!("{:?}", args.shard)),
        ("shares_machine", format!("{:?}", args.shares_machine())),
        ("wait", format!("{:?}", args.wait)),
        ("only", format!("{:?}", args.only)),
        ("list", format!("{:?}", args.list)),
        ("table", format!("{:?}", args.table)),
        ("flags", format!("{:?}", args.flags)),
        ("quiet", format!("{:?}", args.messages.quiet)),
        ("json", format!("{:?}", args.messages.json)),
    ]
    .into()
}

#[test]
fn every_flag_sets_the_option_that_it_is_for_and_no_other() {
    let rows: [Row; 14] = [
        ("--scenes room,garden", &[("scenes", "[\"room\", \"garden\"]")]),
        ("--variant a=--no-mesh", &[("variants", "[Variant { name: \"a\", flags: [\"--no-mesh\"] }]")]),
        ("--seeds 3,4", &[("seeds", "[3, 4]")]),
        ("--protocol a", &[("protocol", "Some(A)")]),
        ("--jobs 3", &[("jobs", "3")]),
        ("--shard 1/4", &[("shard", "Some(Shard { index: 1, of: 4 })"), ("shares_machine", "true")]),
        ("--beside-others", &[("shares_machine", "true")]),
        ("--wait 60", &[("wait", "60")]),
        ("--only a/room-3", &[("only", "[\"a/room-3\"]")]),
        ("--list", &[("list", "true")]),
        ("--table", &[("table", "true")]),
        ("--quiet", &[("quiet", "true")]),
        ("--json", &[("json", "true")]),
        ("-- --antialias", &[("flags", "[\"--antialias\"]")]),
    ];
    assert_flags("bench", &rows, &["output"], asked);
}
