//! Records of a run: progress reports, the outcome of surface selection, and timings.

use std::time::Instant;

use super::{Phase, checkpoint::CheckpointError};

/// A progress report, made every few iterations.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Progress {
    /// Current phase.
    pub phase: Phase,
    /// Iterations done in this phase.
    pub iteration: u32,
    /// Iterations of this phase.
    pub of: u32,
    /// (1 − w)·L1 + w·(1 − SSIM) of the last view, w the option `ssim_weight`.
    pub loss: f64,
    /// Number of splats.
    pub splats: usize,
    /// Mean PSNR of up to four held-out views, whenever they were just rendered, dB.
    pub psnr: Option<f64>,
    /// Seconds since the reporting run began, excluding the time before it was resumed.
    pub seconds: f64,
}

/// What a run tells while it goes on.
#[derive(Clone, Copy, Debug)]
pub enum Event<'a> {
    /// A progress report.
    Progress(&'a Progress),
    /// A checkpoint could not be written, for the first time in this run, which goes on.
    Unsaved {
        /// Why not.
        error: &'a CheckpointError,
        /// Whether it is that after the last iteration, with which the scene is written all the same.
        is_last: bool,
    },
}

/// Counts of the triangles of a surface made from the capture, by the verdict of held-back training views. The others
/// were kept.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Selection {
    /// All triangles judged.
    pub triangles: usize,
    /// Dropped as unseen by the judging views; seen by a single view counts as unseen where these see most triangles
    /// several times or are not held back, and for triangles of the shell.
    pub unseen: usize,
    /// Dropped because maps explain their surroundings much worse than splats do.
    pub worse: usize,
    /// Dropped as part of connected pieces that are too small in the views.
    pub small: usize,
}

impl Selection {
    /// Number of triangles kept.
    #[must_use]
    pub fn kept(&self) -> usize {
        // Saturating, since a checkpoint may hold any numbers.
        self.triangles.saturating_sub(self.unseen).saturating_sub(self.worse).saturating_sub(self.small)
    }
}

/// The record of a run, from its first iteration to its last.
pub(super) struct Log {
    start: Instant,
    /// Time up to which seconds are already in [`Past`].
    counted: Instant,
    /// The part that goes on in a resumed run.
    pub(super) past: Past,
    /// Phase and iterations of the last step done.
    pub(super) reached: (Phase, u32),
    /// Number of iterations repeated because lists were too short for them.
    pub(super) repeated_iterations: u32,
    /// Whether it was told that a checkpoint could not be written.
    pub(super) told_unsaved: bool,
}

/// History, times and memory of the whole training, including before a stop.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Past {
    /// The reports that are also made by an uninterrupted run.
    pub(super) history: Vec<Progress>,
    /// Seconds of all phases and of what happens between them.
    seconds: f64,
    joint_seconds: f64,
    joint_iterations: u32,
    /// Peak bytes of buffers on the adapter.
    peak_gpu_bytes: u64,
}

impl Log {
    pub(super) fn new() -> Self {
        let start = Instant::now();
        let reached = (Phase::Surface, 0);
        let past = Past::default();
        Self { start, counted: start, past, reached, repeated_iterations: 0, told_unsaved: false }
    }

    /// Seconds since the run began.
    pub(super) fn seconds(&self) -> f64 {
        self.start.elapsed().as_secs_f64()
    }

    /// Counts an iteration that began at `begin` as done.
    pub(super) fn count(&mut self, phase: Phase, begin: Instant) {
        let now = Instant::now();
        self.past.seconds += (now - self.counted).as_secs_f64();
        self.counted = now;
        if phase == Phase::Joint {
            self.past.joint_seconds += begin.elapsed().as_secs_f64();
            self.past.joint_iterations = self.past.joint_iterations.saturating_add(1);
        }
    }

    /// Takes back the last `again` iterations, including one that began at `begin`, which will be repeated. Their time
    /// counts.
    pub(super) fn take_back(&mut self, again: u32, phase: Phase, begin: Instant) {
        self.repeated_iterations += again;
        if phase == Phase::Joint {
            self.past.joint_seconds += begin.elapsed().as_secs_f64();
            self.past.joint_iterations = self.past.joint_iterations.saturating_sub(again - 1);
        }
    }

    /// Counts the peak bytes of this run; returns those of the whole training.
    pub(super) fn peak_gpu_bytes(&mut self, bytes: u64) -> u64 {
        self.past.peak_gpu_bytes = self.past.peak_gpu_bytes.max(bytes);
        self.past.peak_gpu_bytes
    }

    /// Seconds of all phases and of what happens between them, until now.
    pub(super) fn training_seconds(&self) -> f64 {
        self.past.seconds + self.counted.elapsed().as_secs_f64()
    }

    /// Mean seconds per iteration of the joint phase; `None` before it.
    pub(super) fn seconds_per_iteration(&self) -> Option<f64> {
        let Past { joint_seconds, joint_iterations, .. } = self.past;
        (joint_iterations > 0).then(|| joint_seconds / f64::from(joint_iterations))
    }
}

/// Phases in the order of their numbers in [`Past::to_words`].
const PHASES: [Phase; 3] = [Phase::Surface, Phase::Warmup, Phase::Joint];

impl Past {
    /// Encodes the history for a checkpoint, bit for bit: some 40 bytes per report.
    pub(super) fn to_words(&self) -> Vec<u32> {
        let mut words = [self.seconds, self.joint_seconds].map(halves).as_flattened().to_vec();
        words.push(self.joint_iterations);
        words.extend(low_and_high(self.peak_gpu_bytes));
        for Progress { phase, iteration, of, loss, splats, psnr, seconds } in &self.history {
            let phase = PHASES.iter().position(|p| p == phase).unwrap_or(0) as u32;
            words.extend([phase, *iteration, *of, u32::try_from(*splats).unwrap_or(u32::MAX)]);
            words.extend([*loss, psnr.unwrap_or(f64::NAN), *seconds].map(halves).as_flattened());
        }
        words
    }

    /// Decodes the words of [`Self::to_words`]; `None` if they are something else.
    pub(super) fn from_words(words: &[u32]) -> Option<Self> {
        let ([t0, t1, j0, j1, joint_iterations, b0, b1], rows) = words.split_first_chunk()?;
        let (rows, []) = rows.as_chunks() else { return None };
        let history = rows.iter().map(|&[phase, iteration, of, splats, l0, l1, p0, p1, s0, s1]| {
            Some(Progress {
                phase: *PHASES.get(phase as usize)?,
                iteration,
                of,
                loss: whole(l0, l1),
                splats: splats as usize,
                psnr: Some(whole(p0, p1)).filter(|db| !db.is_nan()),
                seconds: whole(s0, s1),
            })
        });
        Some(Self {
            history: history.collect::<Option<_>>()?,
            seconds: whole(*t0, *t1),
            joint_seconds: whole(*j0, *j1),
            joint_iterations: *joint_iterations,
            peak_gpu_bytes: joined(*b0, *b1),
        })
    }
}

fn halves(value: f64) -> [u32; 2] {
    low_and_high(value.to_bits())
}

fn whole(low: u32, high: u32) -> f64 {
    f64::from_bits(joined(low, high))
}

fn low_and_high(bits: u64) -> [u32; 2] {
    [bits as u32, (bits >> 32) as u32]
}

fn joined(low: u32, high: u32) -> u64 {
    u64::from(high) << 32 | u64::from(low)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn none_are_kept_of_counts_that_make_no_sense() {
        let selection = Selection { triangles: 9, unseen: usize::MAX, worse: 1, small: usize::MAX };
        assert_eq!(selection.kept(), 0);
        assert_eq!(Selection { unseen: 2, small: 3, ..selection }.kept(), 3);
    }

    #[test]
    fn what_was_before_a_stop_survives_bit_for_bit() {
        let report =
            |phase, psnr| Progress { phase, iteration: 10, of: 90, loss: 0.1, splats: 7, psnr, seconds: 1.0 / 3.0 };
        let history = vec![report(Phase::Surface, None), report(Phase::Warmup, Some(20.1)), report(Phase::Joint, None)];
        let peak_gpu_bytes = (3 << 32) + 1;
        let past = Past { history, seconds: 0.9, joint_seconds: 0.7, joint_iterations: 3, peak_gpu_bytes };
        let words = past.to_words();
        assert_eq!(Past::from_words(&words), Some(past));
        assert_eq!(Past::from_words(&Past::default().to_words()), Some(Past::default()));
        assert_eq!(Past::from_words(&words[..words.len() - 1]), None);
        assert_eq!(Past::from_words(&[]), None);
        assert_eq!(Past::from_words(&[0, 0, 0, 0, 0, 0, 0, 3, 1, 1, 1, 0, 0, 0, 0, 0, 0]), None, "no such phase");
    }

    /// In every phase, and including the work between iterations.
    #[test]
    fn the_time_of_a_training_goes_on_where_it_was_stopped() {
        let mut log = Log::new();
        log.past = Past { seconds: 100.0, ..Past::default() };
        std::thread::sleep(Duration::from_millis(3));
        log.count(Phase::Warmup, Instant::now());
        let kept = Past::from_words(&log.past.to_words()).unwrap().seconds;
        assert!((100.003..200.0).contains(&kept), "{kept}");
        assert!(log.training_seconds() >= kept && log.seconds_per_iteration().is_none());
        log.count(Phase::Joint, Instant::now());
        let counted = log.past.seconds - 100.0;
        assert!(counted <= log.seconds() + 1e-9, "some of it counts twice: {counted} s");
    }
}
