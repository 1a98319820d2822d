//! What a checkpoint of a static scene holds, and how a run goes on from it.

use std::{collections::BTreeMap, path::Path};

use glam::{Vec2, Vec3};
use serde_json::{Value, json};

use super::{
    Phase, Selection, SurfaceOrigin, TrainError, TrainOptions,
    checkpoint::Checkpoint,
    density::mcmc::EpochWeight,
    static_scene::{Past, finite},
};
use crate::{
    render::gpu::{
        exposure::ExposureState, per_view::PerView, pose::PoseState, state::SplatState, training::Training,
        vertices::VertexState,
    },
    scene::{Atlas, HybridScene, Mesh, SceneError, Texture},
};

/// The state of a run between two iterations.
pub(super) struct Saved {
    pub(super) phase: Phase,
    /// Iterations done in this phase.
    pub(super) iteration: u32,
    /// What the meshes were made of.
    pub(super) surface: Option<SurfaceOrigin>,
    /// What became of their triangles, once it is known.
    pub(super) selection: Option<Selection>,
    pub(super) meshes: Vec<Mesh>,
    splats: SplatState,
    statistics: Vec<f32>,
    texel_moments: (Vec<f32>, Vec<f32>),
    pub(super) vertices: VertexState,
    exposures: Option<ExposureState>,
    /// Being refined, or as they were.
    pub(super) poses: Option<PoseState>,
    epoch: EpochWeight,
    /// Lengths of the GPU's lists: a step whose lists are too short sees less of the scene.
    lists: [usize; 2],
    pub(super) past: Past,
}

/// What must be the same in a run that goes on from a checkpoint.
pub(super) struct Identity<'a> {
    pub(super) options: &'a TrainOptions,
    /// Views and source of the mesh.
    pub(super) input: Value,
    /// The run makes its surface itself: its vertices move.
    pub(super) finds_surface: bool,
}

impl Saved {
    /// Reads back everything from the GPU; `poses` are those that are no longer there. Names the parameter group that holds a NaN or an
    /// infinity, if one does.
    pub(super) fn capture(
        training: &Training,
        scene: &HybridScene,
        (phase, iteration): (Phase, u32),
        (surface, selection): (Option<SurfaceOrigin>, Option<Selection>),
        poses: Option<&PoseState>,
        epoch: &EpochWeight,
        past: Past,
    ) -> Result<Self, TrainError> {
        let (splats, texel_moments) = (training.read_splats()?, training.read_texel_moments()?);
        // Before meshes refuse them, which do not know the iteration.
        finite(&splats, [&texel_moments.0, &texel_moments.1], phase, iteration)?;
        Ok(Self {
            phase,
            iteration,
            surface,
            selection,
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

    /// Puts splats, statistics and moments onto the GPU; the maps are already there, from `meshes`.
    pub(super) fn restore(self, training: &mut Training) -> Result<EpochWeight, TrainError> {
        training.write_splats(&self.splats)?;
        training.lengthen_lists(self.lists)?;
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
    pub(super) fn write(self, path: &Path, run: &Identity) -> Result<(), TrainError> {
        let (mut tensors, mut indices) = (BTreeMap::new(), BTreeMap::new());
        let mut meshes = vec![];
        for (i, mesh) in self.meshes.iter().enumerate() {
            let atlas = mesh.atlas();
            let mut put = |name: &str, values: Vec<f32>| tensors.insert(format!("mesh{i}/{name}"), values);
            put("positions", bytemuck::cast_slice(mesh.positions()).to_vec());
            put("corner_uvs", bytemuck::cast_slice(mesh.corner_uvs()).to_vec());
            put("base", atlas.base().texels().to_vec());
            put("bands", atlas.bands().map_or(vec![], |b| b.texels().to_vec()));
            indices.insert(format!("mesh{i}/triangles"), mesh.triangles().as_flattened().to_vec());
            let size = |t: &Texture| json!([t.width(), t.height(), t.channels()]);
            meshes.push(json!({ "base": size(atlas.base()), "bands": atlas.bands().map(size) }));
        }
        tensors.insert("vertices/pixel".to_owned(), vec![self.vertices.pixel]);
        tensors.insert("vertices/normals".to_owned(), self.vertices.normals);
        tensors.insert("vertices/moments".to_owned(), self.vertices.moments);
        if let Some(exposures) = self.exposures {
            put_views("exposures", exposures, &mut tensors, &mut indices);
        }
        if let Some(poses) = self.poses {
            put_views("poses", poses, &mut tensors, &mut indices);
        }
        indices.insert("log".to_owned(), self.past.to_words());
        tensors.insert("texels/m".to_owned(), self.texel_moments.0);
        tensors.insert("texels/v".to_owned(), self.texel_moments.1);
        tensors.insert("statistics".to_owned(), self.statistics);
        tensors.insert("epoch_weight".to_owned(), self.epoch.weight);
        let meta = json!({
            "phase": self.phase,
            "iteration": self.iteration,
            "surface": self.surface,
            "selection": self.selection,
            "options": run.options,
            "input": run.input,
            "lists": self.lists,
            "meshes": meshes,
            "epoch_iterations": self.epoch.iterations,
        });
        Ok(Checkpoint { meta, splats: self.splats, tensors, indices }.write(path)?)
    }

    /// Reads a checkpoint that was written on the same input with the same options, but for how often to report and
    /// save.
    pub(super) fn read(path: &Path, run: &Identity) -> Result<Self, TrainError> {
        let Checkpoint { meta, splats, mut tensors, mut indices } = Checkpoint::read(path)?;
        let refused = |why: String| TrainError::Resume(format!("{}: {why}", path.display()));
        let damaged = |what: &str| refused(format!("{what} is missing or damaged"));
        let field = |name: &str| meta.get(name).cloned().ok_or_else(|| damaged(name));
        // The mesh first, since it decides whether there is a warm-up, and how long.
        let (input, mesh) = (field("input")?, |input: &Value| input["mesh"].as_str().unwrap_or("?").to_owned());
        let [had, has] = [&input, &run.input].map(mesh);
        if had != has {
            return Err(refused(format!(
                "expected a checkpoint of a run with the same mesh, but that was {had} and is {has}"
            )));
        }
        let before: TrainOptions = serde_json::from_value(field("options")?).map_err(|_| damaged("options"))?;
        if let Some(change) = changed_option(&before, run.options) {
            return Err(refused(format!("expected a checkpoint of a run with the same options, but {change}")));
        }
        if input != run.input {
            let expected =
                "expected a checkpoint of the same photographs and masks at the same size, cameras and points";
            return Err(refused(format!("{expected}, found others")));
        }
        let mut take = |name: String| tensors.remove(&name).ok_or_else(|| damaged(&name));
        let invalid = |e: SceneError| refused(e.to_string());
        let mut meshes = vec![];
        let described: Vec<Value> = serde_json::from_value(field("meshes")?).map_err(|_| damaged("meshes"))?;
        for (i, sizes) in described.iter().enumerate() {
            let positions = take(format!("mesh{i}/positions"))?;
            let uvs = take(format!("mesh{i}/corner_uvs"))?;
            let name = format!("mesh{i}/triangles");
            let triangles = indices.remove(&name).ok_or_else(|| damaged(&name))?;
            let texture = |name: &str, texels: Vec<f32>| -> Result<Option<Texture>, TrainError> {
                let Some(size) = sizes.get(name).filter(|s| !s.is_null()) else { return Ok(None) };
                let [w, h, c]: [u32; 3] = serde_json::from_value(size.clone()).map_err(|_| damaged(name))?;
                Ok(Some(Texture::new(w, h, c, texels).map_err(invalid)?))
            };
            let base = texture("base", take(format!("mesh{i}/base"))?)?.ok_or_else(|| damaged("base"))?;
            let bands = texture("bands", take(format!("mesh{i}/bands"))?)?;
            let mesh = Mesh::new(
                rows(&positions).ok_or_else(|| damaged("positions"))?.iter().copied().map(Vec3::from_array).collect(),
                rows(&triangles).ok_or_else(|| damaged("triangles"))?.to_vec(),
                rows::<_, 6>(&uvs)
                    .ok_or_else(|| damaged("corner_uvs"))?
                    .iter()
                    .map(|c| [0, 2, 4].map(|k| Vec2::new(c[k], c[k + 1])))
                    .collect(),
                Atlas::new(base, bands).map_err(invalid)?,
            );
            meshes.push(mesh.map_err(invalid)?);
        }
        let statistics = take("statistics".to_owned())?;
        let weight = take("epoch_weight".to_owned())?;
        let texel_moments = (take("texels/m".to_owned())?, take("texels/v".to_owned())?);
        let pixel = take("vertices/pixel".to_owned())?;
        let vertices = VertexState {
            pixel: pixel.first().copied().ok_or_else(|| damaged("vertices/pixel"))?,
            normals: take("vertices/normals".to_owned())?,
            moments: take("vertices/moments".to_owned())?,
        };
        let views = run.input["views"].as_array().map_or(0, Vec::len);
        let exposures = match run.options.exposure {
            true => {
                Some(take_views("exposures", views, &mut tensors, &mut indices).ok_or_else(|| damaged("exposures"))?)
            }
            false => None,
        };
        let poses = match run.options.refine_poses {
            true => Some(take_views("poses", views, &mut tensors, &mut indices).ok_or_else(|| damaged("poses"))?),
            false => None,
        };
        let past = indices.remove("log").and_then(|words| Past::from_words(&words)).ok_or_else(|| damaged("log"))?;
        let count: usize = meshes.iter().map(|m| m.positions().len()).sum();
        let phase: Phase = serde_json::from_value(field("phase")?).map_err(|_| damaged("phase"))?;
        let iteration: u32 = serde_json::from_value(field("iteration")?).map_err(|_| damaged("iteration"))?;
        let iterations = run.options.iterations_of(phase, run.finds_surface);
        if iteration > iterations {
            return Err(refused(format!(
                "iteration: expected at most the {iterations} of its phase, found {iteration}"
            )));
        }
        let moves = phase != Phase::Surface && run.finds_surface;
        if moves && (vertices.normals.len(), vertices.moments.len()) != (3 * count, 2 * count) {
            return Err(damaged("vertices"));
        }
        if splats.sh_degree != run.options.sh_degree {
            return Err(damaged("sh_degree"));
        }
        if statistics.len() != 4 * splats.len() {
            return Err(damaged("statistics"));
        }
        if !weight.is_empty() && weight.len() != splats.len() {
            return Err(damaged("epoch_weight"));
        }
        Ok(Self {
            phase,
            iteration,
            surface: serde_json::from_value(field("surface")?).map_err(|_| damaged("surface"))?,
            selection: serde_json::from_value(field("selection")?).map_err(|_| damaged("selection"))?,
            meshes,
            splats,
            statistics,
            texel_moments,
            vertices,
            exposures,
            poses,
            past,
            lists: serde_json::from_value(field("lists")?).map_err(|_| damaged("lists"))?,
            epoch: EpochWeight {
                weight,
                iterations: serde_json::from_value(field("epoch_iterations")?)
                    .map_err(|_| damaged("epoch_iterations"))?,
            },
        })
    }
}

/// Lists of a checkpoint by their names.
type Named<T> = BTreeMap<String, Vec<T>>;

/// Puts in what views have of their own, as `what`.
fn put_views<const N: usize>(what: &str, of: PerView<N>, tensors: &mut Named<f32>, indices: &mut Named<u32>) {
    let [first, second] = of.moments;
    for (name, floats) in [("values", of.values), ("m", first), ("v", second)] {
        tensors.insert(format!("{what}/{name}"), floats);
    }
    indices.insert(format!("{what}/steps"), of.steps);
}

/// Takes out what [`put_views`] put in, if it is all there for so many views.
fn take_views<const N: usize>(
    what: &str,
    views: usize,
    tensors: &mut Named<f32>,
    indices: &mut Named<u32>,
) -> Option<PerView<N>> {
    let mut take = |name: &str| tensors.remove(&format!("{what}/{name}"));
    let (values, moments) = (take("values")?, [take("m")?, take("v")?]);
    let of = PerView { values, moments, steps: indices.remove(&format!("{what}/steps"))? };
    of.is_of(views).then_some(of)
}

/// Values by rows of `N`; `None` if some are left.
fn rows<T, const N: usize>(values: &[T]) -> Option<&[[T; N]]> {
    let (rows, rest) = values.as_chunks();
    rest.is_empty().then_some(rows)
}

/// The first option that matters to the result and differs.
fn changed_option(before: &TrainOptions, now: &TrainOptions) -> Option<String> {
    // By way of text, where 0.01 is no longer than that in f32 either.
    let value = |o: &TrainOptions| {
        let text = serde_json::to_string(&TrainOptions { checkpoint_every: 0, eval_every: 0, ..o.clone() })?;
        serde_json::from_str(&text)
    };
    let (Ok(Value::Object(before)), Ok(Value::Object(now))) = (value(before), value(now)) else { return None };
    let (name, value) = before.iter().find(|(name, value)| now.get(*name) != Some(value))?;
    Some(format!("{} was {value} and is {}", name.replace('_', " "), now.get(name).unwrap_or(&Value::Null)))
}
