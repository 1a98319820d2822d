//! Which checkpoints a run accepts as its own.

use super::*;
use crate::optimize::Density;

fn input() -> Input {
    let view = InputView {
        name: "a.png".to_owned(),
        width: 4,
        height: 3,
        camera: u64::MAX,
        photograph: 70,
        mask: None,
        held_out: None,
        lens: "None".to_owned(),
    };
    let mesh = InputMesh::Given { triangles: 2, shape: u64::MAX - 1 };
    Input {
        views: vec![view.clone(), InputView { mask: Some(9), held_out: Some(true), ..view }],
        points: 5,
        positions: 1 << 63,
        mesh,
    }
}

/// Reason why a run with the input and options `now` refuses a checkpoint of those `before`, after `change` edits the
/// file's metadata.
fn refusal(
    (before, now): (&Input, &Input),
    options: (&TrainOptions, &TrainOptions),
    change: impl FnOnce(&mut Value),
) -> Option<String> {
    // Converted to text and back, as in a file.
    let text = json!({ "input": before, "options": options.0 }).to_string();
    let mut meta = serde_json::from_str(&text).unwrap();
    change(&mut meta);
    let run = Identity { options: options.1, input: now.clone(), finds_surface: false };
    run.check(&Checkpoint { meta, ..Checkpoint::default() }).err()
}

#[test]
fn a_run_takes_checkpoints_of_its_own_input_alone() {
    let (own, options) = (input(), TrainOptions::default());
    let after = |change: fn(&mut Input)| {
        let mut other = own.clone();
        change(&mut other);
        let [there, back] = [(&other, &own), (&own, &other)].map(|of| refusal(of, (&options, &options), |_| {}));
        assert_eq!(there.is_some(), back.is_some());
        there
    };
    assert_eq!(after(|_| {}), None);
    let changes: [fn(&mut Input); 11] = [
        |i| i.views[0].name = "b.png".to_owned(),
        |i| i.views[0].width = 3,
        |i| i.views[0].height = 4,
        |i| i.views[1].camera -= 1,
        |i| i.views[0].photograph = 71,
        |i| i.views[1].mask = None,
        |i| i.views[1].held_out = Some(false),
        |i| i.views[0].lens.push('?'),
        |i| i.views.truncate(1),
        |i| i.points = 6,
        |i| i.positions += 1,
    ];
    for (i, change) in changes.into_iter().enumerate() {
        let said = after(change).unwrap_or_default();
        assert!(said.ends_with("at the same size, cameras and points, found others"), "{i}: {said}");
    }
    let said = after(|i| i.mesh = InputMesh::Given { triangles: 2, shape: 255 }).unwrap_or_default();
    let meshes = "it was given, 2 triangles, 00000000000000ff and is now given, 2 triangles, fffffffffffffffe";
    assert!(said.ends_with(meshes), "{said}");
    assert!(after(|i| i.mesh = InputMesh::Points).is_some_and(|said| said.contains("it was points and is now given")));
}

/// A checkpoint whose input cannot be identified is refused.
#[test]
fn an_input_that_is_damaged_is_no_input() {
    let (own, options) = (input(), TrainOptions::default());
    for field in ["views", "points", "positions", "mesh"] {
        let said = refusal((&own, &own), (&options, &options), |meta| meta["input"][field] = Value::Null);
        assert_eq!(said.as_deref(), Some("input is missing or damaged"), "{field}");
    }
    let said = refusal((&own, &own), (&options, &options), |meta| meta["input"]["views"][1]["camera"] = Value::Null);
    assert_eq!(said.as_deref(), Some("input is missing or damaged"));
    let said = refusal((&own, &own), (&options, &options), |meta| meta["options"]["seed"] = json!("one"));
    assert_eq!(said.as_deref(), Some("options is missing or damaged"));
}

#[test]
fn options_that_matter_are_those_of_the_checkpoint() {
    let (own, d) = (input(), TrainOptions::default);
    let said = |before: TrainOptions, now: TrainOptions| refusal((&own, &own), (&before, &now), |_| {});
    let seldom = TrainOptions { checkpoint_every: 7, eval_every: 9, ..d() };
    assert_eq!(said(d(), seldom.clone()), None);
    let endless = TrainOptions { lambda: f32::INFINITY, ..d() };
    assert_eq!(said(endless.clone(), endless.clone()), None);
    for (before, now, expected) in [
        (TrainOptions { seed: 3, ..d() }, seldom, "seed was 3 and is now 0"),
        (d(), TrainOptions { ssim_weight: 0.3, ..d() }, "ssim weight was 0.2 and is now 0.3"),
        (d(), TrainOptions { density: Density::Inria, ..d() }, "density was \"mcmc\" and is now \"inria\""),
        (d(), TrainOptions { max_splats: Some(5), ..d() }, "max splats was null and is now 5"),
        (d(), endless, "lambda was 0.01 and is now null"),
    ] {
        let said = said(before, now).unwrap_or_default();
        assert_eq!(said, format!("expected a checkpoint of a run with the same options, but {expected}"));
    }
    // Values that are written alike can still differ: NaN is null, and so is infinity.
    let unknown = TrainOptions { lambda: f32::NAN, ..d() };
    assert_eq!(
        changed_option(&unknown, &TrainOptions { lambda: f32::INFINITY, ..d() }).as_deref(),
        Some("one was another")
    );
}
