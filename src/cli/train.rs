//! From photographs to a scene, with its scores.

mod args;
mod notes;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context as _, Result, ensure};
use centaur::atomic::Aside;
use centaur::capture::Capture;
use centaur::evaluate;
use centaur::format::{gltf, ply};
use centaur::metrics::Evaluation;
use centaur::optimize::{self, Checkpoints, Outcome, RefinedPose, Session, Trained};

pub(super) use self::args::Args;
use super::eval::{self, Details};
use super::history::Record;
use super::progress::Reporter;
use super::{interrupt, output};

pub(super) fn run(args: &Args) -> Result<()> {
    args.check()?;
    let capture = args.open()?;
    let (mesh, of_mesh) = args.mesh(&capture)?;
    let lpips = args.lpips.open()?;
    let gpu = args.adapter.open()?;
    let options = args.options();
    let stop = stop_flag(args)?;
    let scores = will_be_scored(args, &capture)?;
    let mut told = notes::before_training(args, &capture, &gpu, scores);
    told.extend(of_mesh);
    let aside = set_aside(args)?;
    told.extend(aside.iter().map(|aside| {
        format!("{}: was left by another run and is now {}", args.checkpoint().display(), aside.path().display())
    }));
    if !args.messages.json {
        told.iter().for_each(|note| output::note(note));
    }
    let mut reporter = Reporter::new(&args.messages);
    let session = Session {
        gpu: &gpu,
        checkpoints: if args.resume {
            Checkpoints::Resume(args.checkpoint())
        } else {
            Checkpoints::Save(args.checkpoint())
        },
        stop: &stop,
        progress: &mut |progress| reporter.update(progress),
    };
    let trained = optimize::train(&capture, mesh, &options, session);
    reporter.finish();
    // Those of other runs are aside as yet.
    let has_saved = args.checkpoint().exists();
    if let (Err(_), Some(aside)) = (&trained, aside)
        && aside.back().is_ok_and(|is_back| is_back)
    {
        output::note(&format!("{}: is back, since this run left none", args.checkpoint().display()));
    }
    let trained = trained.map_err(|error| notes::with_advice(error, args, has_saved))?;
    if matches!(trained.outcome, Outcome::Interrupted) {
        let checkpoint = args.checkpoint();
        let line = format!("saved {}; the same command with --resume continues", checkpoint.display());
        return report_interruption(args, ("checkpoint", &checkpoint), &line, &told);
    }
    let record = Record::new(&capture, &options, gpu.adapter(), &trained)?;
    let written = write(args, &capture, &trained, &record);
    if written.is_err() && has_saved {
        output::note(&format!(
            "{}: is kept; the same command with --resume goes on from it",
            args.checkpoint().display()
        ));
    }
    written?;
    let mut evaluation = None;
    if scores {
        let mut settings = record.settings();
        let origin = trained.surface.map(notes::in_words);
        settings.extend(origin.map(|origin| ("surface".to_owned(), origin.to_owned())));
        settings.extend(notes::moved(&trained).map(|moved| ("poses".to_owned(), moved)));
        let details = Details {
            scene_file: &args.output,
            lpips: lpips.as_ref(),
            folder: args.report.as_deref(),
            settings: &settings,
            training: Some(&record),
            messages: &args.messages,
            stop: &stop,
        };
        evaluation = eval::evaluate(&gpu, &trained.scene, &capture, &details)
            .with_context(|| format!("{} is written, but not its evaluation", args.output.display()))?;
        if evaluation.is_none() {
            let line = format!("wrote {}, without scores; centaur eval gives them", args.output.display());
            return report_interruption(args, ("scene", &args.output), &line, &told);
        }
    }
    let capped = notes::capped(args, &trained, &gpu);
    if !args.messages.json {
        capped.iter().for_each(|note| output::note(note));
    }
    told.extend(capped);
    if args.messages.json {
        print_json(args, &capture, &trained, &told, evaluation.as_ref())?;
    } else {
        print(args, &trained, evaluation.as_ref())?;
    }
    // Everything is written and said; what was kept for resuming has served.
    let _ = std::fs::remove_file(args.checkpoint());
    Ok(())
}

/// Set by signals, and by the end of stdin where that is asked for.
fn stop_flag(args: &Args) -> Result<Arc<AtomicBool>> {
    let stop = interrupt::stop_flag();
    if args.stop_at_eof {
        // A terminal that goes away hangs up on all: where that ends whoever holds the other end, it is heard of by that.
        #[cfg(unix)]
        signal_hook::flag::register(signal_hook::consts::SIGHUP, Arc::default()).context("cannot handle SIGHUP")?;
        let flag = Arc::clone(&stop);
        std::thread::spawn(move || {
            // However it ends.
            let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
            flag.store(true, Ordering::Relaxed);
        });
    }
    Ok(stop)
}

/// Whether there is something to score, with all that it takes.
fn will_be_scored(args: &Args, capture: &Capture) -> Result<bool> {
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
        // One that cannot be read is better known now than after hours.
        evaluate::check_photographs(capture)?;
    }
    Ok(scores)
}

fn write(args: &Args, capture: &Capture, trained: &Trained, record: &Record) -> Result<()> {
    let cameras: Vec<_> = capture.views.iter().zip(&trained.cameras).map(|(v, c)| (v.name.clone(), *c)).collect();
    gltf::write_glb(&args.output, &trained.scene, &cameras, Some(serde_json::to_value(record)?))?;
    if let Some(path) = &args.ply {
        ply::write_with(path, &trained.scene.splats, &[], trained.scene.composition.pixel_filter)?;
    }
    Ok(())
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
        "outcome": "finished", "scene": args.output, "points": capture.points.len(), "seconds_per_iteration": trained.seconds_per_iteration,
        "repeated_iterations": trained.repeated_iterations, "surface": trained.surface,
        "selection": trained.selection, "shell_triangles": trained.shell_triangles, "faint_triangles": trained.faint_triangles,
        "occluded_splats": trained.occluded_splats,
        "notes": told.iter().cloned().chain(notes::at_the_end(args, trained)).collect::<Vec<_>>(),
        "exposures": exposures, "poses": poses,
        "settings": args.options(), "evaluation": evaluation,
    }))
}

fn print(args: &Args, trained: &Trained, evaluation: Option<&Evaluation>) -> Result<()> {
    evaluation.map_or(Ok(()), |e| output::print(&format!("{e}")))?;
    notes::moved(trained).map_or(Ok(()), |moved| output::print(&format!("poses: {moved}")))?;
    notes::at_the_end(args, trained).map_or(Ok(()), |note| output::print(&format!("note: {note}")))?;
    output::print(&format!("wrote {}", args.output.display()))
}

/// What an interrupted run left stays, under another name, where this one does not go on from it.
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

/// Ctrl-C is no failure: the work so far is in a file, which is named and described.
fn report_interruption(args: &Args, (kind, file): (&str, &Path), line: &str, notes: &[String]) -> Result<()> {
    if args.messages.json {
        return output::print_json(&serde_json::json!({ "outcome": "interrupted", kind: file, "notes": notes }));
    }
    output::print(&format!("stopped; {line}"))
}
