//! Films of `centaur render`, made by ffmpeg.

use std::process::Command;

use crate::cameras::{run, write_ball};
use crate::common::{centaur, failure, stderr, write_capture};
use centaur::scene::Composition;

#[cfg(unix)]
#[test]
fn films_are_made_by_ffmpeg_or_not_begun() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_capture(&at("capture"), 9, (32, 24));
    write_ball(&at("ball.ply"), Composition::default());
    run(
        folder.path(),
        &["cameras", "orbit", "capture", "-o", "orbit.json", "--frames", "3", "--size", "21x15", "--fps", "12.5"],
    );
    let render = ["render", "ball.ply", "--cameras", "orbit.json", "-o", "frames", "--video", "film.mp4"];
    let film = |script: Option<&str>| {
        let _ = std::fs::remove_dir_all(at("bin"));
        std::fs::create_dir(at("bin")).unwrap();
        if let Some(script) = script {
            std::fs::write(
                at("bin/ffmpeg"),
                format!("#!/bin/sh\n[ \"$1\" = -version ] && exit\nPATH=/usr/bin:/bin\n{script}\n"),
            )
            .unwrap();
            std::fs::set_permissions(at("bin/ffmpeg"), PermissionsExt::from_mode(0o755)).unwrap();
        }
        let mut command = centaur(folder.path());
        // Temporary files are beside the film, even if the system's temporary folder is not available.
        let output = command.args(render).env("PATH", at("bin")).env("TMPDIR", at("none")).output().unwrap();
        (output.status.code(), stderr(&output))
    };
    let (code, said) = film(None);
    let expected = "error: film.mp4: cannot be made: there is no ffmpeg on PATH; install it";
    assert!(code == Some(1) && said.starts_with(expected), "{code:?} {said}");
    assert!(!at("frames").exists() && !at("film.mp4").exists(), "it was rendered for nothing");

    let (code, said) = film(Some("for last; do :; done; cat > \"$last\"; echo \"$*\" > arguments"));
    assert_eq!((code, &said[..]), (Some(0), ""));
    let names = [0, 1, 2].map(|i| at("frames").join(format!("frame_0000{i}.png")));
    let fed: Vec<u8> = names.iter().flat_map(|name| std::fs::read(name).unwrap()).collect();
    assert!(std::fs::read(at("film.mp4")).unwrap() == fed);
    assert!(std::fs::read_to_string(at("arguments")).unwrap().contains("-framerate 12.5 -i -"));

    // Also with the film in the folder of the pictures, which does not exist yet.
    let among = ["render", "ball.ply", "--cameras", "orbit.json", "-o", "new", "--video", "./new/film.mp4"];
    let output = centaur(folder.path()).args(among).env("PATH", at("bin")).output().unwrap();
    assert_eq!((output.status.code(), &*stderr(&output)), (Some(0), ""));
    assert!(std::fs::read(at("new/film.mp4")).unwrap() == fed);

    std::fs::remove_file(at("film.mp4")).unwrap();
    let (code, said) = film(Some("echo 'Unknown encoder libx264' >&2; exit 1"));
    assert_eq!((code, &said[..]), (Some(1), "error: film.mp4: not made: ffmpeg: Unknown encoder libx264\n"));
    // A closed pipe to ffmpeg is an error, unlike one to a reader of our output.
    let (code, said) = film(Some("exec <&-"));
    assert!(code == Some(1) && said.starts_with("error: ") && !at("film.mp4").exists(), "{code:?} {said}");
    let left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert!(left.iter().all(|name| !name.to_string_lossy().starts_with(".centaur-")), "{left:?}");
}

/// Metadata of a film by the real ffmpeg, and its frames: the pictures, with odd sizes, in order and with their
/// colours.
#[test]
#[ignore = "needs ffmpeg: make oracle-ffmpeg"]
fn films_show_the_pictures() {
    let folder = tempfile::tempdir().unwrap();
    let ([width, height], frames) = ([61, 45], 5);
    write_capture(&folder.path().join("capture"), 9, (32, 24));
    write_ball(&folder.path().join("ball.ply"), Composition::default());
    run(
        folder.path(),
        &["cameras", "orbit", "capture", "-o", "orbit.json", "--frames", "5", "--size", "61x45", "--fps", "12.5"],
    );
    run(folder.path(), &["render", "ball.ply", "--cameras", "orbit.json", "-o", "frames", "--video", "film.mp4"]);
    let stdout_of = |program: &str, args: &[&str]| {
        let output = Command::new(program).current_dir(folder.path()).args(args).output().unwrap();
        assert!(output.status.success(), "{}", stderr(&output));
        output.stdout
    };
    let entries = "stream=codec_name,pix_fmt,width,height,r_frame_rate,nb_read_frames,color_range,color_space,color_transfer,color_primaries";
    let told =
        stdout_of("ffprobe", &["-v", "error", "-count_frames", "-show_entries", entries, "-of", "json", "film.mp4"]);
    let told: serde_json::Value = serde_json::from_slice(&told).unwrap();
    let expected = serde_json::json!([{
        "codec_name": "h264", "pix_fmt": "yuv420p", "width": 62, "height": 46, "r_frame_rate": "25/2", "nb_read_frames": "5",
        "color_range": "tv", "color_space": "bt709", "color_transfer": "bt709", "color_primaries": "bt709",
    }]);
    assert_eq!(told["streams"], expected);

    let shown = stdout_of("ffmpeg", &["-v", "error", "-i", "film.mp4", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]);
    assert_eq!(shown.len(), frames * (width + 1) * (height + 1) * 3);
    // Mean difference between a frame of the film and a picture, out of 255, without the column and row that make its
    // sides even.
    let difference = |frame: usize, picture: usize| {
        let picture = image::open(folder.path().join(format!("frames/frame_0000{picture}.png"))).unwrap().to_rgb8();
        let rows = shown.chunks_exact(3 * (width + 1)).skip(frame * (height + 1)).take(height);
        let pairs = rows.flat_map(|row| &row[..3 * width]).zip(picture.as_raw());
        pairs.map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / (3 * width * height) as f64
    };
    for frame in 0..frames {
        let (same, next) = (difference(frame, frame), difference(frame, (frame + 1) % frames));
        assert!(same < 1.0 && next > 2.0 * same, "frame {frame}: {same} from its picture, {next} from the next");
    }

    // Pixels that are twice as wide as high are displayed so, and frames with different pixel aspects make no film.
    let frame = |name: &str, fl_y: u32| {
        serde_json::json!({
            "file_path": name, "w": 64, "h": 48, "fl_x": 30, "fl_y": fl_y,
            "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]],
        })
    };
    let render = ["render", "ball.ply", "--cameras", "wide.json", "-o", "wide", "--video", "wide.mp4"];
    let write = |frames: &[serde_json::Value]| {
        std::fs::write(folder.path().join("wide.json"), serde_json::json!({ "frames": frames }).to_string()).unwrap();
    };
    write(&[frame("a.png", 60), frame("b.png", 30)]);
    let line = failure(folder.path(), centaur(folder.path()).args(render));
    assert_eq!(
        line,
        "error: --video: expected pixels of one shape, found 2 times as wide as high and 1 of b.png; other cameras may help"
    );
    write(&[frame("a.png", 60), frame("b.png", 60)]);
    run(folder.path(), &render);
    let entries = ["-v", "error", "-show_entries", "stream=sample_aspect_ratio", "-of", "csv=p=0", "wide.mp4"];
    assert_eq!(String::from_utf8(stdout_of("ffprobe", &entries)).unwrap().trim(), "2:1");
}
