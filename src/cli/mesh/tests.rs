use centaur::capture::LoadOptions;
use clap::Parser as _;

use crate::cli::flag_tests::{Options, Row, assert_flags};
use crate::cli::{Cli, Command};

/// Options of `centaur mesh` with these flags.
fn asked(flags: &str) -> Options {
    let words = ["centaur", "mesh", "capture", "-o", "surface.glb"].into_iter().chain(flags.split_whitespace());
    let Command::Mesh(args) = Cli::try_parse_from(words).unwrap().command else { unreachable!() };
    let LoadOptions { downscale, images, masks, without_points } = args.loading.options();
    assert!(!without_points);
    [
        ("mesh", format!("{:?}", args.mesh)),
        ("triangles", format!("{:?}", args.triangles)),
        ("planar", format!("{:?}", args.planar.is_auto())),
        ("holes", format!("{:?}", args.holes.is_auto())),
        ("crumbs", format!("{:?}", args.crumbs.is_auto())),
        ("texture_size", format!("{:?}", args.texture_size)),
        ("truth", format!("{:?}", args.truth)),
        ("truth_radius", format!("{:?}", args.truth_radius)),
        ("within", format!("{:?}", args.within)),
        ("downscale", format!("{downscale:?}")),
        ("images", format!("{images:?}")),
        ("masks", format!("{masks:?}")),
        ("quiet", format!("{:?}", args.messages.quiet)),
        ("json", format!("{:?}", args.messages.json)),
    ]
    .into()
}

#[test]
fn every_flag_sets_the_option_that_it_is_for_and_no_other() {
    let rows: [Row; 15] = [
        ("--mesh a.obj", &[("mesh", "Some(\"a.obj\")")]),
        ("--triangles 140", &[("triangles", "140")]),
        ("--planar off", &[("planar", "false")]),
        ("--holes off beside --mesh a.obj", &[("holes", "false")]),
        ("--crumbs off beside --mesh a.obj", &[("crumbs", "false")]),
        ("--texture-size 150", &[("texture_size", "150")]),
        ("--truth b.obj", &[("truth", "Some(\"b.obj\")")]),
        ("--truth-radius 2.5 beside --truth b.obj", &[("truth_radius", "Some(2.5)")]),
        ("--within 0.125 beside --truth b.obj", &[("within", "Some(0.125)")]),
        ("--downscale 2", &[("downscale", "Factor(2)")]),
        ("--max-side 64", &[("downscale", "MaxSide(64)")]),
        ("--images images_4", &[("images", "Some(\"images_4\")")]),
        ("--masks", &[("masks", "true")]),
        ("--quiet", &[("quiet", "true")]),
        ("--json", &[("json", "true")]),
    ];
    assert_flags("mesh", &rows, &["output", "adapter"], asked);
}
