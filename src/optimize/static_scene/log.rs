//! What a run tells of itself: reports, and how long its steps take.

use std::time::Instant;

use super::Phase;

/// A sign of life, every few iterations.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct Progress {
    /// Current phase.
    pub phase: Phase,
    /// Iterations done in this phase.
    pub iteration: u32,
    /// Iterations of this phase.
    pub of: u32,
    /// (1 − w)·L1 + w·(1 − SSIM) of the last view, w the option `ssim_weight`.
    pub loss: f64,
    /// Splats there are.
    pub splats: usize,
    /// PSNR of a held-out view, whenever one was just rendered, dB.
    pub psnr: Option<f64>,
    /// Seconds since this run began (not counting what a resumed run did before).
    pub seconds: f64,
}

/// Kept from the first iteration to the last.
pub(super) struct Log {
    start: Instant,
    /// All reports.
    pub(super) history: Vec<Progress>,
    /// The last iteration.
    pub(super) reached: (Phase, u32),
    /// Taken again, since lists were too short for them.
    pub(super) repeated_iterations: u32,
    joint_seconds: f64,
    joint_iterations: u32,
}

impl Log {
    pub(super) fn new() -> Self {
        Self {
            start: Instant::now(),
            history: vec![],
            reached: (Phase::Surface, 0),
            repeated_iterations: 0,
            joint_seconds: 0.0,
            joint_iterations: 0,
        }
    }

    /// Seconds since the run began.
    pub(super) fn seconds(&self) -> f64 {
        self.start.elapsed().as_secs_f64()
    }

    /// An iteration that began then is done.
    pub(super) fn count(&mut self, phase: Phase, begin: Instant) {
        if phase == Phase::Joint {
            self.joint_seconds += begin.elapsed().as_secs_f64();
            self.joint_iterations += 1;
        }
    }

    /// The last `again` iterations, one that began then among them, are to be taken again. Their time counts.
    pub(super) fn take_back(&mut self, again: u32, phase: Phase, begin: Instant) {
        self.repeated_iterations += again;
        if phase == Phase::Joint {
            self.joint_seconds += begin.elapsed().as_secs_f64();
            self.joint_iterations = self.joint_iterations.saturating_sub(again - 1);
        }
    }

    /// Of the joint phase; `None` before it.
    pub(super) fn seconds_per_iteration(&self) -> Option<f64> {
        (self.joint_iterations > 0).then(|| self.joint_seconds / f64::from(self.joint_iterations))
    }
}
