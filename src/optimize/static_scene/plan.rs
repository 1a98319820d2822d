//! Contents and schedule of each phase of a run.

use super::{Phase, Run};
use crate::optimize::{Background, Density, resolution::ResolutionSchedule, schedule::Schedule};

/// Contents and schedule of one phase.
pub(super) struct Plan {
    pub(super) phase: Phase,
    /// Iterations of this phase done before this run.
    pub(super) from: u32,
    pub(super) iterations: u32,
    /// Iterations of the splats before this phase.
    pub(super) clock: u32,
    pub(super) schedule: Schedule,
    pub(super) resolution: ResolutionSchedule,
    pub(super) has_mesh: bool,
    pub(super) moves_vertices: bool,
}

impl Run<'_> {
    /// Plan for a phase of which `from` iterations are done.
    pub(super) fn plan(&self, phase: Phase, from: u32, has_mesh: bool) -> Plan {
        let o = self.options;
        // Surface and joint phase are two parts of one run of the splats, with one clock.
        let before = o.surface_phase_iterations();
        let is_second_part = phase == Phase::Joint && self.finds_surface();
        let iterations = o.iterations_of(phase, self.finds_surface());
        let clock = if is_second_part { before } else { 0 };
        let mut schedule = Schedule::new(if phase == Phase::Warmup { o.warmup } else { o.iterations });
        if o.density == Density::Mcmc {
            schedule = schedule.for_mcmc();
        }
        if o.background == Background::White {
            schedule = schedule.with_white_background();
        }
        if phase == Phase::Surface {
            schedule = schedule.before_surface(before);
        }
        if is_second_part {
            // If no triangle was kept, there was no handover.
            schedule = if has_mesh { schedule.handed_over(before) } else { schedule.after_surface(before) };
        }
        // Surfaces are made, and maps warmed up, at full size.
        let half = o.iterations / 2;
        let full_from = match phase {
            _ if !o.coarse_to_fine => 0,
            Phase::Warmup => 0,
            _ if self.finds_surface() => half.min(before - before / 4),
            _ => half,
        };
        let resolution = ResolutionSchedule { full_from };
        // The user's mesh stays where it is.
        let moves_vertices = has_mesh && self.finds_surface();
        Plan { phase, from, iterations, clock, schedule, resolution, has_mesh, moves_vertices }
    }
}
