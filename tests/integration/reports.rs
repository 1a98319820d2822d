//! Scores and reports of `centaur train` and `centaur eval`: which views are held out, what is said of the training,
//! and how far the commands are.

use crate::common::{self, demo};

/// With `--all-views` the scene learns from held-out views too, and scores carry a note.
#[test]
fn all_views_are_trained_on_if_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let capture = folder.path().join("capture");
    std::fs::create_dir(&capture).unwrap();
    // All photographs are grey except the first by name, which is held out and red.
    let frames: Vec<_> = (0..8)
        .map(|i| {
            let (sin, cos) = (0.1 * f64::from(i)).sin_cos();
            let color = if i == 0 { [200, 30, 30] } else { [90; 3] };
            image::RgbImage::from_pixel(24, 24, image::Rgb(color)).save(capture.join(format!("{i}.png"))).unwrap();
            let pose =
                [[cos, 0.0, sin, 3.0 * sin], [0.0, 1.0, 0.0, 0.0], [-sin, 0.0, cos, 3.0 * cos], [0.0, 0.0, 0.0, 1.0]];
            serde_json::json!({ "file_path": format!("{i}.png"), "transform_matrix": pose })
        })
        .collect();
    let write = |frames: &[serde_json::Value]| {
        let file = serde_json::json!({ "w": 24, "h": 24, "fl_x": 24.0, "frames": frames });
        std::fs::write(capture.join("transforms.json"), file.to_string()).unwrap();
    };
    let start = |line: &str| common::centaur(folder.path()).args(line.split(' ')).output().unwrap();
    let run = |line: &str| {
        let output = start(line);
        assert!(output.status.success(), "{line}: {}", common::stderr(&output));
        serde_json::from_slice::<serde_json::Value>(&output.stdout).unwrap()
    };
    write(&frames);
    let scored = |more: &str| {
        let flags = "--no-mesh --iterations 500 --max-splats 300 --quiet --json";
        let trained = run(&format!("train capture -o scene.glb {flags}{more}"));
        let scores = run("eval scene.glb capture --quiet --json");
        let says = scores["notes"].to_string().contains("trained on all views");
        let psnr = scores["views"][0]["psnr"].as_f64().unwrap();
        (trained["evaluation"].is_null(), trained["settings"]["split"].clone(), says, psnr)
    };
    let (is_null, split, says, without) = scored("");
    assert!(!is_null && split == "every8th" && !says);
    // Without the first, the second is held out, which was trained on.
    write(&frames[1..]);
    let notes = run("eval scene.glb capture --quiet --json")["notes"].to_string();
    assert!(notes.contains("trained on 1 of the 1 views that are scored"), "{notes}");
    write(&frames);
    let (is_null, split, says, with) = scored(" --all-views");
    assert!(is_null && split == "all" && says);
    assert!(with > without + 1.0, "{with} dB, {without} dB where it is held out");

    // Of two photographs one is held out, and the one left is not enough.
    write(&frames[..2]);
    let few = "train capture -o few.glb --no-mesh --iterations 5 --max-splats 50 --quiet";
    let said = common::stderr(&start(few));
    assert!(said.trim_end().ends_with("found 2 in all; --all-views holds none out"), "{said}");
    run(&format!("{few} --json --all-views"));
}

/// If scoring fails, the report of another run remains whole; other files are reported.
#[test]
fn a_report_has_no_pictures_of_another() {
    let folder = tempfile::tempdir().unwrap();
    common::write_capture(&folder.path().join("capture"), 10, (48, 32));
    let at = |name: &str| folder.path().join(name);
    let run = |line: &str| {
        let output = common::centaur(folder.path()).args(line.split(' ')).output().unwrap();
        (output.status.code(), common::stderr(&output))
    };
    let score = || run("eval scene.glb capture -o report --quiet");
    let train = "train capture -o scene.glb --no-mesh --max-splats 50 --iterations 2 --report report --quiet";
    assert_eq!(run(train), (Some(0), String::new()));
    assert_eq!(score(), (Some(0), String::new()));
    // Without the first view, others are held out.
    let list = at("capture/sparse/0/images.txt");
    let views = std::fs::read_to_string(&list).unwrap();
    let note = |left: &str| {
        format!("note: report: has 2 pictures of an earlier report, of views that are not scored now: {left}\n")
    };
    std::fs::write(&list, views.split_once("\n\n").unwrap().1).unwrap();
    let (code, said) = run(train);
    assert!(code == Some(0) && said.contains(&note("000.png, 008.png")), "{said}");
    std::fs::write(&list, &views).unwrap();
    let (code, said) = score();
    assert!(code == Some(0) && said.contains(&note("001.png, 009.png")), "{said}");
    let all = ["000.png", "001.png", "008.png", "009.png"];
    let left = || -> Vec<_> {
        let entries = std::fs::read_dir(at("report")).unwrap().map(|entry| entry.unwrap().file_name());
        let mut names: Vec<_> = entries.map(|name| name.into_string().unwrap()).collect();
        names.sort();
        names
    };
    let whole = [&all[..], &["metrics.json", "report.html"]].concat();
    assert_eq!(left(), whole);
    let report =
        || ["000.png", "metrics.json", "report.html"].map(|name| std::fs::read(at("report").join(name)).unwrap());
    let before = report();
    let picture = at("capture/images/000.png");
    let mut brighter = image::open(&picture).unwrap().to_rgb8();
    brighter.pixels_mut().for_each(|pixel| pixel.0[0] = 255 - pixel.0[0]);
    brighter.save(&picture).unwrap();
    // The first of two views is scored, the second turns out to be broken after its header.
    let last = at("capture/images/008.png");
    let bytes = std::fs::read(&last).unwrap();
    std::fs::write(&last, &bytes[..bytes.len() / 2]).unwrap();
    let (code, said) = score();
    assert!(code == Some(1) && said.lines().last().unwrap().starts_with("error: "), "{said}");
    assert_eq!(left(), whole);
    assert!(report() == before, "the picture of the first view is another");
}

/// Lines of progress on stderr.
fn progress(output: &std::process::Output) -> Vec<serde_json::Value> {
    let line = |line: &str| serde_json::from_str::<serde_json::Value>(line).unwrap()["progress"].take();
    common::stderr(output).lines().map(line).collect()
}

/// Also after training, from the scene's record.
#[test]
fn commands_say_how_far_they_are_and_evaluations_what_the_training_took() {
    let folder = tempfile::tempdir().unwrap();
    let demo = demo().display().to_string();
    let run = |command: &str, args: &str| {
        let mut centaur = common::centaur(folder.path());
        let output = centaur.args(command.split(' ').chain([&*demo]).chain(args.split(' '))).output().unwrap();
        assert!(output.status.success(), "{}", common::stderr(&output));
        output
    };
    let json = |output: &std::process::Output| serde_json::from_slice::<serde_json::Value>(&output.stdout).unwrap();
    let flags = "--no-mesh --max-side 64 --max-splats 500 --iterations 40 --eval-every 20 --json -o scene.glb";
    let training = run("train", flags);
    let (trained, told) = (json(&training), progress(&training));
    let views = trained["evaluation"]["views"].as_array().unwrap().len();
    assert!(views > 0 && trained["seconds_per_iteration"].as_f64().unwrap() > 0.0);

    let evaluation = run("eval scene.glb", "--max-side 64 --json -o scores");
    let (evaluated, scored) = (json(&evaluation), progress(&evaluation));
    assert_eq!(scored.len(), views);
    for (i, line) in scored.iter().enumerate() {
        assert_eq!((&line["phase"], &line["view"], &line["of"]), (&"scoring".into(), &(i + 1).into(), &views.into()));
        assert!(line["seconds"].as_f64().unwrap() >= 0.0);
    }
    assert_eq!(told.iter().filter(|line| line["phase"] == "scoring").count(), views, "as after training");
    for name in ["seconds_per_iteration", "training_seconds", "training_peak_gpu_bytes"] {
        assert!(trained[name].is_number(), "{name}: {trained}");
        assert_eq!((&evaluated[name], &trained["evaluation"][name]), (&trained[name], &trained[name]));
    }
    // Training needs gradients and moments in addition to the memory of rendering, which is the same directly after it
    // and later.
    let peak = &evaluated["peak_gpu_bytes"];
    assert_eq!(peak, &trained["evaluation"]["peak_gpu_bytes"]);
    assert!(peak.as_u64().unwrap() < trained["training_peak_gpu_bytes"].as_u64().unwrap(), "{peak}");
    let metrics = std::fs::read(folder.path().join("scores/metrics.json")).unwrap();
    let mut said = evaluated.clone();
    said.as_object_mut().unwrap().remove("notes");
    assert_eq!(serde_json::from_slice::<serde_json::Value>(&metrics).unwrap(), said);
    let report = || std::fs::read_to_string(folder.path().join("scores/report.html")).unwrap();
    for part in [
        "training time",
        "time per iteration",
        " MiB training<",
        "--ssim-weight",
        "aria-label=\"loss\"",
        "aria-label=\"held-out PSNR (dB)\"",
        "<polyline",
    ] {
        assert!(report().contains(part), "{part}");
    }

    // Splats alone do not contain the record.
    let mut convert = common::centaur(folder.path());
    assert!(convert.args(["convert", "scene.glb", "splats.ply", "--quiet"]).status().unwrap().success());
    let evaluation = run("eval splats.ply", "--max-side 64 --json --quiet -o scores");
    assert!(evaluation.stderr.is_empty() && json(&evaluation)["seconds_per_iteration"].is_null());
    assert!(!report().contains("<polyline") && !report().contains("--ssim-weight"));

    let rendering =
        common::centaur(folder.path()).args(["render", "scene.glb", "--json", "-o", "pictures"]).output().unwrap();
    let (pictures, told) = (json(&rendering)["pictures"].as_array().unwrap().len(), progress(&rendering));
    assert!(told.len() == pictures && told.iter().all(|line| line["phase"] == "rendering"), "{told:?}");

    let fusion = run("mesh scene.glb", "--max-side 64 --triangles 500 --texture-size 128 --json -o surface.glb");
    let (fused, told) = (json(&fusion), progress(&fusion));
    assert_eq!((fused["origin"].as_str(), told.len()), (Some("splats"), 48));
    assert!(told.iter().zip(1..).all(|(line, view)| line["phase"] == "fusing" && line["view"] == view), "{told:?}");
}
