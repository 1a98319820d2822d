//! Density control between two iterations: splats come back from the GPU and go there rearranged.

use super::{plan::Plan, setup::Setup};
use crate::{
    optimize::{
        Density, TrainError,
        arrangement::Arrangement,
        density::{
            self, Statistics,
            inria::{self, InriaOptions},
            mcmc::{self, EpochWeight, McmcOptions},
        },
        finite::finite_group,
    },
    render::gpu::training::Training,
};

/// Runs the density step or opacity reset that is due after `done` iterations of this phase, if any. Growth stops at
/// `max_splats`.
pub(super) fn control_density(
    setup: &Setup,
    training: &mut Training,
    plan: &Plan,
    epoch: &mut EpochWeight,
    max_splats: usize,
    done: u32,
) -> Result<(), TrainError> {
    // The schedule's clock continues from phase to phase.
    let (o, schedule, age) = (setup.options, &plan.schedule, plan.clock + done);
    let (densify, reset) = (schedule.densifies_after(age), schedule.resets_opacity_after(age));
    if !densify && !reset {
        return Ok(());
    }
    let statistics = training.read_statistics()?;
    let statistics = Statistics(bytemuck::cast_slice(&statistics));
    let mut splats = Arrangement::new(training.read_geometry()?);
    // Other non-finite values are reported with the loss.
    finite_group(splats.first_non_finite(), plan.phase, done)?;
    if densify {
        match o.density {
            Density::Inria | Density::Absgs => {
                let mut options = match o.density {
                    Density::Absgs => InriaOptions::absolute(setup.scales.extent, max_splats),
                    _ => InriaOptions::new(setup.scales.extent, max_splats),
                };
                if schedule.prunes_large(age) {
                    options = options.pruning_large();
                }
                inria::densify(&mut splats, statistics, &options, age, o.seed);
            }
            Density::Mcmc => {
                let mut options = McmcOptions::new(max_splats, plan.has_mesh).with_dropout(plan.dropout(setup, age));
                if o.asks_for_size() {
                    options = options.arriving_in(schedule.density_steps_from(age), splats.len());
                }
                // After a handover less than an interval may have passed.
                epoch.add(statistics, schedule.densify_interval.min(done));
                let views = setup.train.len() as u32;
                mcmc::relocate_and_add(&mut splats, epoch, views, &options, age, o.seed);
            }
        }
    }
    if reset {
        density::reset_opacity(&mut splats);
    }
    training.rearrange(splats.geometry(), splats.sources())?;
    if !densify {
        // The statistics have not been used to judge splats, so they are kept.
        training.write_statistics(bytemuck::cast_slice(statistics.0));
    }
    training.smooth();
    Ok(())
}
