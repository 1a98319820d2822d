//! Training: from photographs to a scene, with its scores.

mod args;
mod notes;
mod surface;

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context as _, Result, ensure};
use centaur::atomic::Aside;
use centaur::capture::Capture;
use centaur::evaluate;
use centaur::format::{gltf, ply};
use centaur::metrics::{Evaluation, Lpips, ViewScore};
use centaur::optimize::{self, Checkpoints, Event, MeshSource, Outcome, RefinedPose, Session, TrainOptions, Trained};
use centaur::render::gpu::Gpu;

pub(super) use self::args::Args;
use super::eval::{self, Details};
use super::history::{self, Record};
use super::progress::Reporter;
use super::{interrupt, output};

pub(super) fn run(args: &Args) -> Result<()> {
    args.check()?;
    let lock = args.lock()?;
    let capture = args.open()?;
    let (mesh, of_mesh) = args.mesh(&capture)?;
    let lpips = args.lpips.open()?;
    let gpu = args.adapter.open()?;
    let options = args.options();
    let stop = stop_flag(args)?;
    let scores = will_be_scored(args, &capture, lpips.as_ref())?;
    let mut told = notes::before_training(args, &capture, &gpu, scores);
    told.extend(of_mesh);
    if !lock.excludes() {
        let output = args.output.display();
        told.push(format!("{output}: files cannot be locked here: a second training would not be refused"));
    }
    let aside = set_aside(args)?;
    told.extend(aside.iter().map(|aside| {
        format!(
            "{}: was left by another run, and was renamed to {}",
            args.checkpoint().display(),
            aside.path().display()
        )
    }));
    told.extend(args.report.as_deref().and_then(|folder| eval::leftover(folder, &capture)));
    let had_scene = args.output.exists();
    // What goes on may have written it itself, before its scores.
    if had_scene && !args.resume {
        told.push(format!("{}: exists, and will be replaced when this training is done", args.output.display()));
    }
    tell(&told, args);
    let trained = train(args, (&capture, mesh, &options), &gpu, &stop, aside, &mut told)?;
    if matches!(trained.outcome, Outcome::Interrupted) {
        let checkpoint = args.checkpoint();
        let line = format!("saved {}; the same command with --resume continues", checkpoint.display());
        if had_scene {
            let earlier = format!("{}: is still the scene of an earlier run", args.output.display());
            tell(std::slice::from_ref(&earlier), args);
            told.push(earlier);
        }
        return report_interruption(args, &[("checkpoint", &checkpoint)], &line, &told);
    }
    let record = Record::new(&capture, &options, gpu.adapter(), &trained)?;
    write(args, &capture, &trained, &record)?;
    let scored = scores.then(|| score(args, &capture, &trained, &record, (&gpu, lpips.as_ref()), &stop)).transpose()?;
    if let Some(ControlFlow::Break(_)) = scored {
        let checkpoint = args.checkpoint();
        let mut left = vec![("scene", &args.output)];
        let mut line = format!("wrote {}, without scores; centaur eval gives them", args.output.display());
        if checkpoint.exists() {
            line += &format!(", as does the same command with --resume, from {}", checkpoint.display());
            left.push(("checkpoint", &checkpoint));
        }
        return report_interruption(args, &left, &line, &told);
    }
    let evaluation = scored.and_then(ControlFlow::continue_value);
    let empty =
        evaluation.as_ref().and_then(eval::without_pixels).map(|note| format!("{}: {note}", args.capture.display()));
    let last: Vec<String> = notes::capped(args, &trained, &gpu).into_iter().chain(empty).collect();
    tell(&last, args);
    told.extend(last);
    let printed = if args.messages.json {
        print_json(args, &capture, &trained, &told, evaluation.as_ref())
    } else {
        print(args, &trained, evaluation.as_ref())
    };
    // All output is complete, or nobody reads it; the checkpoint is no longer needed.
    if printed.as_ref().map_or_else(output::is_read_enough, |()| true) {
        let _ = std::fs::remove_file(args.checkpoint());
    }
    printed
}

/// Prints notes at once for persons; with JSON they come at the end.
fn tell(told: &[String], args: &Args) {
    if !args.messages.json {
        told.iter().for_each(|note| output::note(note));
    }
}

/// Trains, and adds the notes of it to `told`. If training fails before it has saved a checkpoint, the file in `aside`
/// is restored.
fn train(
    args: &Args,
    (capture, mesh, options): (&Capture, MeshSource, &TrainOptions),
    gpu: &Gpu,
    stop: &AtomicBool,
    aside: Option<Aside>,
    told: &mut Vec<String>,
) -> Result<Trained> {
    let checkpoint = args.checkpoint();
    let mut reporter = Reporter::new(&args.messages, options.phases(&mesh));
    let session = Session {
        gpu,
        checkpoints: if args.resume {
            Checkpoints::Resume(checkpoint.clone())
        } else {
            Checkpoints::Save(checkpoint.clone())
        },
        stop,
        progress: &mut |event| match event {
            Event::Progress(progress) => reporter.update(progress),
            Event::Unsaved { error, is_last } => {
                let then =
                    if is_last { "the scene is written all the same" } else { "the training goes on, and tries again" };
                let note = format!("{error}: no checkpoint is saved; {then}");
                reporter.say(&note, args.messages.json);
                told.push(note);
            }
        },
    };
    let trained = optimize::train(capture, mesh, options, session);
    reporter.finish();
    trained.map_err(|error| {
        // Checkpoints of other runs have been set aside.
        let has_saved = checkpoint.exists();
        if aside.is_some_and(|aside| aside.back().is_ok_and(|is_back| is_back)) {
            output::note(&format!("{}: is restored, because this run saved no checkpoint", checkpoint.display()));
        }
        notes::with_advice(error, args, has_saved)
    })
}

/// Stop flag, set by signals, and by the end of stdin if requested.
fn stop_flag(args: &Args) -> Result<Arc<AtomicBool>> {
    let stop = interrupt::stop_flag(&args.messages);
    if args.stop_at_eof {
        // A lost terminal sends hangups to all: if one ends the process at the other end, the end of stdin reports it.
        // (`interrupt` may have found hangups ignored.)
        #[cfg(unix)]
        signal_hook::flag::register(signal_hook::consts::SIGHUP, Arc::default()).context("cannot handle SIGHUP")?;
        let flag = Arc::clone(&stop);
        let thread = std::thread::Builder::new().name("end of stdin".into()).spawn(move || {
            // Ends with stdin, in whatever way.
            let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
            flag.store(true, Ordering::Relaxed);
        });
        thread.context("cannot wait for the end of stdin")?;
    }
    Ok(stop)
}

/// Whether there is something to score; checks that it can be scored.
fn will_be_scored(args: &Args, capture: &Capture, lpips: Option<&Lpips>) -> Result<bool> {
    let scores = !args.no_eval && !args.split().split(&capture.views).1.is_empty();
    ensure!(
        scores || args.report.is_none(),
        "{}: expected held-out views for --report, found none",
        args.capture.display()
    );
    if let Some(folder) = &args.report {
        eval::report_pictures(folder, capture)?;
    }
    if scores {
        evaluate::check_photographs(capture, lpips)?;
    }
    Ok(scores)
}

/// Writes scene and splats; if there is a checkpoint, they can be written again from it.
fn write(args: &Args, capture: &Capture, trained: &Trained, record: &Record) -> Result<()> {
    let cameras: Vec<_> = capture.views.iter().zip(&trained.cameras).map(|(v, c)| (v.name.clone(), *c)).collect();
    let scene = &trained.scene;
    let all = || -> Result<()> {
        gltf::write_glb(&args.output, scene, &cameras, Some(serde_json::to_value(record)?))?;
        if let Some(path) = &args.ply {
            ply::write_with(path, &scene.splats, &[], scene.composition.pixel_filter)?;
        }
        Ok(())
    };
    all().inspect_err(|_| {
        let checkpoint = args.checkpoint();
        if checkpoint.exists() {
            output::note(&format!(
                "{}: is kept; the same command with --resume continues from it",
                checkpoint.display()
            ));
        }
    })
}

/// Scores the held-out views, as [`eval::evaluate`].
fn score(
    args: &Args,
    capture: &Capture,
    trained: &Trained,
    record: &Record,
    (gpu, lpips): (&Gpu, Option<&Lpips>),
    stop: &AtomicBool,
) -> Result<ControlFlow<Vec<ViewScore>, Evaluation>> {
    let mut settings = record.settings();
    let origin = trained.surface.map(notes::in_words);
    settings.extend(origin.map(|origin| ("surface".to_owned(), origin.to_owned())));
    settings.extend(notes::moved(trained).map(|moved| ("poses".to_owned(), moved)));
    let details = Details {
        scene_file: &args.output,
        lpips,
        folder: args.report.as_deref(),
        settings: &settings,
        training: Some(record),
        messages: &args.messages,
        stop,
    };
    eval::evaluate(gpu, &trained.scene, capture, &details)
        .with_context(|| format!("{} is written, but not its evaluation", args.output.display()))
}

fn print_json(
    args: &Args,
    capture: &Capture,
    trained: &Trained,
    told: &[String],
    evaluation: Option<&Evaluation>,
) -> Result<()> {
    let exposures: BTreeMap<&str, [f32; 12]> = trained.exposures.iter().map(|(name, e)| (&**name, *e)).collect();
    let poses: BTreeMap<&str, &RefinedPose> = trained.poses.iter().map(|(name, pose)| (&**name, pose)).collect();
    output::print_json(&serde_json::json!({
        "outcome": "finished", "scene": args.output, "points": capture.points.len(), "masks": capture.has_masks(),
        "training_seconds": trained.training_seconds, "seconds_per_iteration": trained.seconds_per_iteration,
        "training_peak_gpu_bytes": trained.peak_gpu_bytes,
        "repeated_iterations": trained.repeated_iterations, "surface": trained.surface,
        "selection": trained.selection, "shell_triangles": trained.shell_triangles, "faint_triangles": trained.faint_triangles,
        "occluded_splats": trained.occluded_splats,
        "notes": told.iter().cloned().chain(notes::at_the_end(args, trained)).collect::<Vec<_>>(),
        "exposures": exposures, "poses": poses,
        "settings": history::by_name(&args.options())?, "evaluation": evaluation,
    }))
}

fn print(args: &Args, trained: &Trained, evaluation: Option<&Evaluation>) -> Result<()> {
    evaluation.map_or(Ok(()), |e| output::print_lines(e.to_string().split('\n')))?;
    notes::moved(trained).map_or(Ok(()), |moved| output::print(&format!("poses: {moved}")))?;
    notes::at_the_end(args, trained).iter().for_each(|note| output::note(note));
    output::print(&format!("wrote {}", args.output.display()))
}

/// Renames the checkpoint of an interrupted run from which this one does not resume, so that it is kept.
fn set_aside(args: &Args) -> Result<Option<Aside>> {
    let checkpoint = args.checkpoint();
    if args.resume || !checkpoint.is_file() {
        return Ok(None);
    }
    let mut names = (1..).map(|n| checkpoint.with_extension(format!("checkpoint.before-{n}")));
    let name = names.find(|name| !name.exists()).context("no name is left for an earlier checkpoint")?;
    let cannot = format!("cannot rename {}", checkpoint.display());
    Ok(Some(Aside::set(checkpoint, name).context(cannot)?))
}

/// What was done before Ctrl-C is in files, which are named and described. An error, so that what a shell has after `&&` does not go on with less
/// than it was to have.
fn report_interruption(args: &Args, files: &[(&str, &PathBuf)], line: &str, notes: &[String]) -> Result<()> {
    interrupt::stopped(if args.messages.json {
        let mut said = serde_json::json!({ "outcome": "interrupted", "notes": notes });
        files.iter().for_each(|(kind, file)| said[*kind] = serde_json::json!(file));
        output::print_json(&said)
    } else {
        output::print(&format!("stopped; {line}"))
    })
}
