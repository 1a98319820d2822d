//! Content of a static scene's checkpoint, and how a run resumes from it.

mod input;
mod parts;
#[cfg(test)]
mod tests;

pub(super) use input::{Input, InputMesh, InputView};

use std::path::Path;

use serde_json::{Map, Value, json};

use self::parts::{
    Taken, damaged, field, put_epoch, put_floats, put_meshes, put_vertices, put_views, put_words, take_epoch,
    take_floats, take_meshes, take_vertices, take_views, take_words,
};
use super::{
    Phase, Selection, SurfaceOrigin, TrainError, TrainOptions,
    checkpoint::{Checkpoint, CheckpointError},
    density::mcmc::EpochWeight,
    finite::finite,
    log::Past,
};
use crate::{
    render::gpu::{
        exposure::ExposureState, pose::PoseState, state::SplatState, training::Training, vertices::VertexState,
    },
    scene::{HybridScene, Mesh},
};

/// State of a run between two iterations.
pub(super) struct Saved {
    pub(super) phase: Phase,
    /// Iterations done in this phase.
    pub(super) iteration: u32,
    pub(super) found: SurfaceRecord,
    pub(super) meshes: Vec<Mesh>,
    splats: SplatState,
    statistics: Vec<f32>,
    texel_moments: (Vec<f32>, Vec<f32>),
    pub(super) vertices: VertexState,
    exposures: Option<ExposureState>,
    /// Poses while they are refined, or as fixed.
    pub(super) poses: Option<PoseState>,
    epoch: EpochWeight,
    /// Lengths of the GPU's lists, restored so that no step has to be repeated for lists that are too short.
    lists: [usize; 2],
    pub(super) past: Past,
}

/// State of a run between two iterations as far as the host keeps it.
pub(super) struct HostState<'a> {
    /// Phase, and iterations done in it.
    pub(super) reached: (Phase, u32),
    pub(super) found: SurfaceRecord,
    /// Poses, used if they are not on the GPU any more.
    pub(super) poses: Option<&'a PoseState>,
    pub(super) epoch: &'a EpochWeight,
    pub(super) past: Past,
}

/// Record of how the mesh came to be.
#[derive(Clone, Default, serde::Serialize, serde::Deserialize)]
pub(super) struct SurfaceRecord {
    /// Data that the surface was made of.
    pub(super) surface: Option<SurfaceOrigin>,
    /// Reason why there is no surface, where making one failed.
    pub(super) no_surface: Option<String>,
    /// Verdict on its triangles, once they have been judged.
    pub(super) selection: Option<Selection>,
}

/// Everything that must be equal between a checkpoint and the run that resumes from it.
pub(super) struct Identity<'a> {
    pub(super) options: &'a TrainOptions,
    /// Views, points and source of the mesh.
    pub(super) input: Input,
    /// The run makes its surface itself: its vertices move.
    pub(super) finds_surface: bool,
}

impl Saved {
    /// Reads back the whole state from the GPU, beside that of the host. If a parameter group holds a NaN or an
    /// infinity, the error names it.
    pub(super) fn capture(training: &Training, scene: &HybridScene, host: HostState) -> Result<Self, TrainError> {
        let HostState { reached: (phase, iteration), found, poses, epoch, past } = host;
        let (splats, texel_moments) = (training.read_splats()?, training.read_texel_moments()?);
        // Checked before meshes reject them, which do not know the iteration.
        finite(&splats, [&texel_moments.0, &texel_moments.1], phase, iteration)?;
        // Includes exposures and poses, whose numbers are not checked otherwise: reports come at other iterations.
        if let Some(group) = training.status()?.not_finite {
            return Err(TrainError::NotFinite { phase, iteration, group: group.to_owned() });
        }
        Ok(Self {
            phase,
            iteration,
            found,
            meshes: training.read_meshes(&scene.meshes)?,
            vertices: training.read_vertex_state()?,
            exposures: training.read_exposures()?,
            poses: training.read_poses()?.or_else(|| poses.cloned()),
            splats,
            statistics: training.read_statistics()?,
            texel_moments,
            epoch: epoch.clone(),
            lists: training.list_lengths(),
            past,
        })
    }

    /// Uploads splats, statistics and moments to the GPU; the maps are already there, from `meshes`.
    pub(super) fn restore(self, training: &mut Training) -> Result<EpochWeight, TrainError> {
        training.write_splats(&self.splats)?;
        training.lengthen_lists(training.bindable(self.lists))?;
        training.write_statistics(&self.statistics);
        if let Some(exposures) = &self.exposures {
            training.expose(exposures)?;
        }
        let (first, second) = &self.texel_moments;
        if !training.write_texel_moments(first, second) {
            return Err(TrainError::Resume("the moments of the maps do not fit the maps".to_owned()));
        }
        Ok(self.epoch)
    }

    /// Writes the checkpoint to a temporary file and renames it.
    pub(super) fn write(self, path: &Path, run: &Identity) -> Result<(), CheckpointError> {
        self.put(run).write(path)
    }

    /// Reads a checkpoint that was written for the same input and options, except for how often to report and save.
    pub(super) fn read(path: &Path, run: &Identity) -> Result<Self, TrainError> {
        let file = Checkpoint::read(path)?;
        let saved = run.check(&file).and_then(|()| Self::take(file, run));
        let saved = saved.and_then(|saved| saved.fits(run).map(|()| saved));
        saved.map_err(|why| TrainError::Resume(format!("{}: {why}", path.display())))
    }

    fn put(self, run: &Identity) -> Checkpoint {
        let meta = json!({
            "options": run.options,
            "input": run.input,
            "phase": self.phase,
            "iteration": self.iteration,
            "found": self.found,
            "lists": self.lists,
        });
        let mut file = Checkpoint { meta, splats: self.splats, ..Checkpoint::default() };
        put_meshes(&self.meshes, &mut file);
        put_floats("statistics", self.statistics, &mut file);
        put_epoch(self.epoch, &mut file);
        put_floats("texels/m", self.texel_moments.0, &mut file);
        put_floats("texels/v", self.texel_moments.1, &mut file);
        put_vertices(self.vertices, &mut file);
        if let Some(exposures) = self.exposures {
            put_views("exposures", exposures, &mut file);
        }
        if let Some(poses) = self.poses {
            put_views("poses", poses, &mut file);
        }
        put_words("log", self.past.to_words(), &mut file);
        file
    }

    /// Inverse of [`Self::put`], for the options and views of `run`.
    fn take(mut file: Checkpoint, run: &Identity) -> Taken<Self> {
        let (file, views) = (&mut file, run.input.views.len());
        Ok(Self {
            meshes: take_meshes(file)?,
            statistics: take_floats("statistics", file)?,
            epoch: take_epoch(file)?,
            texel_moments: (take_floats("texels/m", file)?, take_floats("texels/v", file)?),
            vertices: take_vertices(file)?,
            exposures: run.options.exposure.then(|| take_views("exposures", views, file)).transpose()?,
            poses: run.options.refine_poses.then(|| take_views("poses", views, file)).transpose()?,
            past: Past::from_words(&take_words("log", file)?).ok_or_else(|| damaged("log"))?,
            phase: field(file, "phase")?,
            iteration: field(file, "iteration")?,
            found: field(file, "found")?,
            lists: field(file, "lists")?,
            splats: std::mem::take(&mut file.splats),
        })
    }

    /// Checks that all parts belong to one state of this run.
    fn fits(&self, run: &Identity) -> Taken<()> {
        let iterations = run.options.iterations_of(self.phase, run.finds_surface);
        if self.iteration > iterations {
            let found = self.iteration;
            return Err(format!("iteration: expected at most the {iterations} of its phase, found {found}"));
        }
        let (splats, vertices) = (self.splats.len(), self.meshes.iter().map(|m| m.positions().len()).sum::<usize>());
        let moves = self.phase != Phase::Surface && run.finds_surface;
        let has_phase = match self.phase {
            Phase::Surface => run.finds_surface && self.meshes.is_empty(),
            Phase::Warmup => !self.meshes.is_empty(),
            Phase::Joint => true,
        };
        let epoch = self.epoch.weight.len();
        let lengths = (self.vertices.normals.len(), self.vertices.moments.len());
        for (fits, what) in [
            (has_phase, "phase"),
            (!moves || lengths == (3 * vertices, 2 * vertices), "vertices"),
            (self.splats.sh_degree == run.options.sh_degree, "sh_degree"),
            (self.statistics.len() == 4 * splats, "statistics"),
            (epoch == 0 || epoch == splats, "epoch_weight"),
        ] {
            if !fits {
                return Err(damaged(what));
            }
        }
        Ok(())
    }
}

impl Identity<'_> {
    /// Checks that a checkpoint was written by such a run.
    fn check(&self, file: &Checkpoint) -> Taken<()> {
        let input: Input = field(file, "input")?;
        // The mesh first, since it decides whether there is a warm-up, and how long.
        let (had, has) = (&input.mesh, &self.input.mesh);
        if had != has {
            return Err(format!(
                "expected a checkpoint of a run with the same mesh, but it was {had} and is now {has}"
            ));
        }
        if let Some(change) = changed_option(&field(file, "options")?, self.options) {
            return Err(format!("expected a checkpoint of a run with the same options, but {change}"));
        }
        if input != self.input {
            let expected =
                "expected a checkpoint of the same photographs and masks at the same size, cameras and points";
            return Err(format!("{expected}, found others"));
        }
        Ok(())
    }
}

/// What of the options that matter to the result differs, if any does.
fn changed_option(before: &TrainOptions, now: &TrainOptions) -> Option<String> {
    let [before, now] = [before, now].map(|o| TrainOptions { checkpoint_every: 0, eval_every: 0, ..o.clone() });
    (before != now).then(|| first_change(&before, &now).unwrap_or_else(|| "one was another".to_owned()))
}

/// The first of them that is written otherwise.
fn first_change(before: &TrainOptions, now: &TrainOptions) -> Option<String> {
    // By way of text, where 0.01 is no longer than that in f32 either.
    let fields = |o: &TrainOptions| {
        let text = serde_json::to_string(o).ok()?;
        serde_json::from_str::<Map<String, Value>>(&text).ok()
    };
    let (before, now) = (fields(before)?, fields(now)?);
    let (name, value) = before.iter().find(|(name, value)| now.get(*name) != Some(value))?;
    Some(format!("{} was {value} and is now {}", name.replace('_', " "), now.get(name).unwrap_or(&Value::Null)))
}
