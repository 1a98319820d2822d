//! Rows, means and notes of the table, and where published rows stand beside them.

use serde_json::json;

use super::*;
use crate::cli::bench::protocol::MIPNERF360;

fn record(variant: &str, scene: &str, seed: u64, psnr: f64) -> Record {
    let lpips = json!({ "net": "vgg", "normalized": 0.3, "unnormalized": 0.2 });
    let evaluation = json!({
        "psnr": psnr, "ssim_inria": 0.8, "ssim_valid": 0.7, "lpips": lpips, "splats": 1000, "fps": 9.5, "protocol": "scored so",
        "adapter": "this one",
    });
    let made = Made {
        variant: variant.to_owned(),
        scene: scene.to_owned(),
        seed,
        capture: None,
        scene_flags: vec![],
        flags: vec!["--flag".to_owned()],
        protocol: Some(Protocol::B),
        at_a_time: 1,
    };
    Record {
        file: format!("out/{variant}/{scene}-{seed}.json").into(),
        made,
        result: json!({ "evaluation": evaluation }),
    }
}

fn table(records: &[Record]) -> Table {
    Table::new(records, Path::new("out")).unwrap()
}

#[test]
fn seeds_then_common_scenes_are_averaged() {
    let mut records = vec![];
    for (variant, more) in [("a", 0.0), ("b", 0.5)] {
        for (scene, psnr) in [("room", 30.0), ("garden", 26.0)] {
            records.extend((0..2).map(|seed| record(variant, scene, seed, psnr + seed as f64 + more)));
        }
    }
    let text = table(&records).to_string();
    for part in [
        "| a | garden | 2 | 26.50 | 0.800 | – | vgg | 0.300 | 0.200 | 1000 |",
        "| **a** | **mean** | 4 | 28.50 |",
        "| **b** | **mean** | 4 | 29.00 |",
        "protocol B",
        "scored so",
        "Adapter: this one.",
        "Flags of b: `--flag`.",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
    assert!(!text.contains("HERA"), "{text}");
    assert_eq!(serde_json::to_value(table(&records)).unwrap()["variants"][1]["mean"]["psnr"], 29.0);
    assert!(!text.contains("inf:"), "{text}");
    // A view equal to its photograph has an infinite PSNR, which is null in JSON; this differs from a missing value.
    let mut perfect = records.clone();
    perfect[0].result["evaluation"]["psnr"] = Value::Null;
    let perfect = table(&perfect).to_string();
    for part in
        ["| a | room | 2 | inf |", "| **a** | **mean** | 4 | inf |", "| **b** | **mean** | 4 | 29.00 |", "PSNR of inf:"]
    {
        assert!(perfect.contains(part), "{part}: {perfect}");
    }
    // A mean over two scenes is not compared with a mean over three.
    records.push(record("b", "bonsai", 0, 99.0));
    let text = table(&records).to_string();
    assert!(
        text.contains("| b | bonsai | 1 | 99.00 |") && text.contains("| **b** | **mean of 2 common** | 4 | 29.00 |"),
        "{text}"
    );
    records.push(record("c", "other", 0, 1.0));
    assert!(!table(&records).to_string().contains("mean"), "nothing is common");
}

/// A job that asked for a mesh and has none says so only in its notes.
#[test]
fn hybrids_have_triangles_and_trainings_their_say() {
    let mut records: Vec<Record> = ["garden", "room"].map(|scene| record("a", scene, 0, 26.0)).into();
    for (record, [triangles, seconds]) in records.iter_mut().zip([[0.0, 100.0], [900.0, 60.0]]) {
        record.result["evaluation"]["triangles"] = json!(triangles);
        record.result["evaluation"]["training_seconds"] = json!(seconds);
        let masks = format!("captures/{}: has no masks: nothing is masked", record.made.scene);
        record.result["notes"] = json!([masks, "--no-mesh: --warmup has no effect"]);
    }
    let more = [Value::Null, json!("captures/garden: the scene has no mesh:\nwhy")];
    records[0].result["notes"].as_array_mut().unwrap().extend(more);
    let text = table(&records).to_string();
    for part in [
        "| splats | triangles | M floats | MB | training, s | s/joint iteration | fps |\n",
        "| a | garden | 1 | 26.00 | 0.800 | – | vgg | 0.300 | 0.200 | 1000 | 0 | – | – | 100.0 | – | 9.5 |\n",
        "| 1000 | 450 | – | – | 80.0 | – | 9.5 |\n",
        "\nNotes of the trainings:\n\n- all: has no masks: nothing is masked\n- all: --no-mesh: --warmup",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
    let last = text.lines().last().unwrap();
    assert!(last.starts_with("- a, garden: the scene has no mesh:") && last.ends_with("why"), "{text}");
    let json = serde_json::to_value(table(&records)).unwrap();
    assert_eq!(json["variants"][0]["rows"][1]["triangles"], 900.0);
    assert_eq!(json["variants"][0]["notes"][0]["scenes"], json!(["garden", "room"]));
    // The number of notes is limited to a readable one; results of older versions have none.
    records[1].result["notes"] = (0..30).map(|i| format!("note {i}")).collect();
    records[0].result["notes"] = Value::Null;
    let text = table(&records).to_string();
    assert!(text.contains("- a, room: note 19\n- and 10 more, which table.json has\n"), "{text}");
    records.truncate(1);
    records[0].result["evaluation"]["triangles"] = Value::Null;
    let text = table(&records).to_string();
    assert!(text.contains("| 1000 | – | – | – | 100.0 |") && !text.contains("Notes of"), "{text}");
    // Times of jobs that shared the machine are none.
    records[0].made.at_a_time = 2;
    assert!(table(&records).to_string().contains("| 1000 | – | – | – | – | – | – |"));
}

/// Two variants of nine scenes would otherwise say the same in eighteen lines.
#[test]
fn equal_notes_are_one_line_that_names_who_gave_them() {
    let mut records = vec![];
    for variant in ["a", "b", "c"] {
        records.extend(["garden", "room"].map(|scene| record(variant, scene, 0, 26.0)));
    }
    let given: [(&str, &[usize]); 5] = [
        ("of all", &[0, 1, 2, 3, 4, 5]),
        ("of two variants", &[0, 1, 2, 3]),
        ("of a scene", &[1, 5]),
        ("of some", &[0, 4, 5]),
        ("of a training", &[2]),
    ];
    for (i, record) in records.iter_mut().enumerate() {
        let notes = given.iter().filter(|(_, trainings)| trainings.contains(&i));
        record.result["notes"] = notes.map(|(text, _)| *text).collect();
        // What is about the file of a scene is of no use here.
        record.result["scene"] = json!(format!("out/{i}.glb"));
        let notes = record.result["notes"].as_array_mut().unwrap();
        notes.push(json!(format!("scene: lies on its side; to set it upright: centaur convert out/{i}.glb OUT.glb")));
    }
    let expected = "\nNotes of the trainings:\n\n- all: of all\n- a and b, all scenes: of two variants\n\
                    - a, garden; c, all scenes: of some\n- a and c, room: of a scene\n- b, garden: of a training\n";
    let text = table(&records).to_string();
    assert!(text.ends_with(expected), "{text}");
}

#[test]
fn a_set_that_is_whole_meets_published_rows() {
    let with = |change: &dyn Fn(usize, &mut Record)| {
        let mut records: Vec<Record> = MIPNERF360.iter().map(|(scene, _)| record("a", scene, 0, 27.0)).collect();
        records.iter_mut().enumerate().for_each(|(i, record)| change(i, record));
        table(&records).to_string()
    };
    let b = with(&|_, _| {});
    assert!(b.contains("| *HERA, filtered* | published | | 27.75 | 0.829 | | vgg | – | 0.194 |"), "{b}");
    assert!(b.contains("\nPublished rows: the nine scenes of Mip-NeRF 360") && b.contains("colours 0…1."), "{b}");
    let a = with(&|_, r| r.made.protocol = Some(Protocol::A));
    assert!(a.contains("| *2DGS* | published | | 26.815 | 0.796 | | vgg | 0.297 | – |"), "{a}");
    assert!(a.contains("| a | room | 1 | 27.00 | 0.700 |") && a.contains("inside the image"), "{a}");
    let free = with(&|_, r| r.made.protocol = None);
    assert!(!free.to_lowercase().contains("published"), "of any size: {free}");
    let alex = with(&|_, r| r.result["evaluation"]["lpips"]["net"] = json!("alex"));
    assert!(alex.contains("| *HERA* | published | | 27.61 | 0.828 | | – | – | – |"), "{alex}");
    let mixed = with(&|i, r| r.result["evaluation"]["lpips"]["net"] = json!(if i == 4 { "alex" } else { "vgg" }));
    assert!(mixed.contains("| **a** | **mean** | 9 | 27.00 | 0.800 | – | – | – |"), "{mixed}");
    // Jobs that run at the same time slow each other down.
    for at_a_time in [0, 2] {
        let crowded = with(&|_, r| r.made.at_a_time = at_a_time);
        assert!(b.contains("| 9.5 |") && !crowded.contains("| 9.5 |"), "{crowded}");
    }
}

#[test]
fn sets_that_come_in_one_size_meet_published_rows() {
    let with = |scenes: &[&str], change: &dyn Fn(&mut Record)| {
        let mut records: Vec<Record> = scenes.iter().map(|scene| record("a", scene, 0, 24.0)).collect();
        for record in &mut records {
            record.made.protocol = None;
            change(record);
        }
        table(&records)
    };
    let sized =
        |size: [u32; 2]| with(&["train", "truck"], &|r| r.result["evaluation"]["views"] = json!([{ "size": size }]));
    assert_eq!((sized([980, 545]).published.len(), sized([1957, 1091]).published.len()), (16, 0));
    let tanks = with(&["train", "truck"], &|_| {}).to_string();
    for part in [
        "| *HERA, filtered* | published: five scenes, unnamed | | 24.39 | 0.824 | | vgg | – | 0.206 |",
        "| *3DGS* | published | | 23.14 | 0.841 | | vgg | – | 0.183 |",
        "| *MeshSplatting* | published | | 20.52 | – | | – | – | – |",
        "\nPublished rows: train and truck of Tanks and Temples",
        "which does not name them",
    ] {
        assert!(tanks.contains(part), "{part}: {tanks}");
    }
    assert_eq!(with(&["train", "truck"], &|r| r.made.protocol = Some(Protocol::B)).published.len(), 16);
    let rooms = with(&["drjohnson", "playroom"], &|_| {}).to_string();
    assert!(
        rooms.contains("| *Brush* | published: nvs-bench, scenes not checked | | 29.85 | 0.911 | | – | – | – |"),
        "{rooms}"
    );
    // No published rows for a subset or a superset of the scenes, for pictures of another size, or with another SSIM.
    let size = |flag: &'static str| move |r: &mut Record| r.made.flags.extend([flag.to_owned(), "2".to_owned()]);
    for other in [
        with(&["truck"], &|_| {}),
        with(&["train", "truck", "Barn"], &|_| {}),
        with(&["train", "playroom"], &|_| {}),
        with(&["train", "truck"], &size("--downscale")),
        with(&["train", "truck"], &size("--max-side=300")),
        with(&["train", "truck"], &|r| r.made.protocol = Some(Protocol::A)),
    ] {
        assert!(other.published.is_empty() && other.published_note.is_none(), "{other}");
    }
    // One variant with the right size is enough: published rows apply to all variants.
    let mut records = vec![];
    for (variant, flag) in [("a", "--antialias"), ("b", "--images")] {
        records.extend(["train", "truck"].map(|scene| record(variant, scene, 0, 24.0)));
        records.iter_mut().filter(|r| r.made.variant == variant).for_each(|r| r.made.flags = vec![flag.to_owned()]);
    }
    assert!(table(&records).published.is_empty());
    records.truncate(2);
    assert_eq!(table(&records).published.len(), 16);
}

#[test]
fn scores_with_masks_stand_alone() {
    let masked = |views: &[bool]| -> Value { views.iter().map(|masked| json!({ "masked": masked })).collect() };
    let mut records = vec![];
    for (scene, psnr, views) in [("demo", 25.0, [false; 2]), ("cup", 30.0, [true; 2]), ("jar", 28.0, [true, false])] {
        let mut record = record("a", scene, 0, psnr);
        record.result["evaluation"]["views"] = masked(&views);
        records.push(record);
    }
    let text = table(&records).to_string();
    for part in [
        "| a | demo | 1 | 25.00 |",
        "| a | cup, masked | 1 | 30.00 |",
        "| a | jar, partly masked | 1 | 28.00 |",
        // A figure that masks do not affect, here the number of splats, has a mean.
        "| **a** | **mean, partly masked** | 3 | – | – | – | – | – | – | 1000 |",
        "\nMasked rows: photographs and renders are multiplied by masks",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
    let json = serde_json::to_value(table(&records)).unwrap();
    let of = |i: usize| json["variants"][0]["rows"][i]["masked"].clone();
    assert_eq!((of(0), of(1), of(2)), (json!("all"), json!("none"), json!("some")));
    let cup = table(&records[1..2]).to_string();
    assert!(cup.contains("| **a** | **mean, masked** | 1 | 30.00 |"), "{cup}");
    let demo = table(&records[..1]).to_string();
    assert!(demo.contains("| **a** | **mean** | 1 | 25.00 |") && !demo.contains("asked"), "{demo}");
}

/// Published rows are of unmasked photographs of the same size.
#[test]
fn scores_with_masks_meet_no_published_rows() {
    let with = |masked: bool| {
        let mut records: Vec<Record> = ["Barn", "Caterpillar", "Ignatius", "train", "truck"]
            .iter()
            .map(|scene| record("a", scene, 0, 24.0))
            .collect();
        for r in &mut records {
            r.made.protocol = None;
            r.result["evaluation"]["views"] = json!([{ "size": [980, 545], "masked": masked }]);
        }
        table(&records).published.len()
    };
    assert_eq!((with(false), with(true)), (5, 0));
}

/// With the flags that `fetch_captures.py tandt` lists.
#[test]
fn scenes_have_flags_of_their_own() {
    let scenes = ["Barn", "Caterpillar", "Ignatius", "train", "truck"];
    let mut records: Vec<Record> = scenes.iter().map(|scene| record("a", scene, 0, 24.0)).collect();
    for r in &mut records {
        r.made.protocol = None;
        if r.made.scene.starts_with(char::is_uppercase) {
            r.made.scene_flags = ["--downscale", "2"].map(str::to_owned).to_vec();
        }
    }
    let five = table(&records);
    assert!(five.published.iter().any(|row| row.method == "HERA, filtered" && row.psnr == 24.39), "{five}");
    assert_eq!(five.variants[0].flags, ["--flag"]);
    assert!(five.to_string().contains("\nFlags of a for Barn, Caterpillar, Ignatius: `--downscale 2`.\n"), "{five}");
    // A variant with a size of its own has no per-scene flags.
    let mut both = records.clone();
    both.extend(scenes.map(|scene| record("b", scene, 0, 24.0)));
    both.iter_mut().for_each(|r| r.made.protocol = None);
    assert_eq!(table(&both).variants.len(), 2);
    // Downscaled by per-scene flags, the pictures are smaller than those distributed, so no published row applies.
    records.retain(|r| r.made.scene.starts_with('t'));
    assert_eq!(table(&records).published.len(), 16);
    records[0].made.scene_flags = vec!["--downscale=2".to_owned()];
    assert!(table(&records).published.is_empty());
}

#[test]
fn what_does_not_compare_is_refused() {
    let error = |change: fn(&mut Record)| {
        let mut records = [record("a", "room", 0, 1.0), record("a", "room", 1, 1.0)];
        change(&mut records[1]);
        Table::new(&records, Path::new("out")).unwrap_err().to_string()
    };
    let protocol = error(|r| r.made.protocol = None);
    assert_eq!(protocol, "out: expected results of one protocol, found another in out/a/room-1.json");
    let flags = error(|r| r.made.flags.clear());
    assert_eq!(flags, "out: expected results of `a` of the same flags, found others in out/a/room-1.json");
    let scene = error(|r| r.made.scene_flags = vec!["--masks".to_owned()]);
    let expected =
        "out: expected results of room with the same flags in scenes.json, found others in out/a/room-1.json";
    assert_eq!(scene, expected);
}
