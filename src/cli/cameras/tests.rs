use clap::Parser as _;

use super::*;
use crate::cli::flag_tests::{Options, Row, assert_flags};
use crate::cli::{Cli, Command};

/// Options of `centaur cameras` with these words.
fn asked(kind: &str, flags: &str) -> Options {
    let words = ["centaur", "cameras", kind, "capture", "-o", "path.glb"].into_iter().chain(flags.split_whitespace());
    let Command::Cameras(args) = Cli::try_parse_from(words).unwrap().command else { unreachable!() };
    let of_files = |files: &FileArgs| {
        vec![("with_scene", format!("{:?}", files.with_scene)), ("json", format!("{:?}", files.json))]
    };
    let of_shot = |shot: &ShotArgs| {
        let Shot { frames, size, fov_y } = shot.shot();
        vec![
            ("fps", format!("{:?}", shot.fps)),
            ("frames", format!("{frames:?}")),
            ("size", format!("{size:?}")),
            ("fov_y", format!("{fov_y:?}")),
            ("up", format!("{:?}", shot.up.up)),
        ]
    };
    let of_around = |around: &AroundArgs| {
        let Around { focus, radius, height, radius_scale, height_scale } = around.around();
        vec![
            ("focus", format!("{:?}", focus.map(|p| p.to_array()))),
            ("radius", format!("{radius:?}")),
            ("height", format!("{height:?}")),
            ("radius_scale", format!("{radius_scale:?}")),
            ("height_scale", format!("{height_scale:?}")),
        ]
    };
    let all = match &args.kind {
        Kind::Orbit { files, shot, around } | Kind::Lemniscate { files, shot, around } => {
            [of_files(files), of_shot(shot), of_around(around)].concat()
        }
        Kind::Spline { files, shot, keys, closed } => {
            let own = vec![("keys", format!("{keys:?}")), ("closed", format!("{closed:?}"))];
            [of_files(files), of_shot(shot), own].concat()
        }
        Kind::Convert { files, sampling } => {
            let Sampling { fps, only, time, without_paths } = sampling.sampling();
            assert_eq!((time, without_paths), (None, false));
            [of_files(files), vec![("fps", format!("{fps:?}")), ("only", format!("{only:?}"))]].concat()
        }
    };
    all.into_iter().collect()
}

const FILES: &[Row] = &[("--with-scene", &[("with_scene", "true")]), ("--json", &[("json", "true")])];

const SHOT: &[Row] = &[
    ("--frames 7", &[("frames", "7")]),
    ("--fps 12.5", &[("fps", "12.5")]),
    ("--size 32x24", &[("size", "Some([32, 24])")]),
    ("--fov 90", &[("fov_y", "Some(1.5707963267948966)")]),
    ("--up -x", &[("up", "Some(MinusX)")]),
    ("--up +z", &[("up", "Some(Z)")]),
];

const AROUND: &[Row] = &[
    ("--focus 1,-2,3.5", &[("focus", "Some([1.0, -2.0, 3.5])")]),
    ("--radius 4", &[("radius", "Some(4.0)")]),
    ("--height -5", &[("height", "Some(-5.0)")]),
    ("--radius-scale 0.5", &[("radius_scale", "0.5")]),
    ("--height-scale -1.5", &[("height_scale", "-1.5")]),
];

const SPLINE: &[Row] = &[("--keys 3", &[("keys", "Some(3)")]), ("--closed", &[("closed", "true")])];

const SAMPLING: &[Row] = &[("--camera a", &[("only", "[\"a\"]")]), ("--fps 12.5", &[("fps", "Some(12.5)")])];

#[test]
fn every_flag_sets_the_option_that_it_is_for_and_no_other() {
    for (kind, rows) in [
        ("orbit", [FILES, SHOT, AROUND].concat()),
        ("spline", [FILES, SHOT, SPLINE].concat()),
        ("lemniscate", [FILES, SHOT, AROUND].concat()),
        ("convert", [FILES, SAMPLING].concat()),
    ] {
        assert_flags(&format!("cameras {kind}"), &rows, &["output"], |flags| asked(kind, flags));
    }
}
