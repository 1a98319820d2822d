//! Movement of mesh vertices along their normals during optimisation.
//!
//! A fused surface is off by a pixel or so, and maps on it blur by as much. Backward: `uv_backward` (overwrites the
//! layers' gradient) → `gradient_peak` → `vertex_backward`; then `move_vertices`: Adam, with its step smoothed over the
//! surface. 48 bytes per vertex and some 28 for its neighbours, 48 per triangle.

use glam::Vec3;

use super::adam::{self, bias_corrections};
use super::device::{Buffer, Frame, Gpu, GpuError, Kernel, Stage, groups};
use super::shader::Defines;
#[cfg(test)]
use super::shader::FIXED_ONE;
#[cfg(test)]
use super::texels::PEAKS;
use super::texels::{PEAK_FRAGMENTS, peak_kernel};
use crate::geometry::{self, Rings};
use crate::scene::Mesh;

/// Pairs of Jacobi iterations: with a smoothness of 8 the remaining error of the slowest local mode is (8/9)¹⁶ ≈ 0.15.
const DIFFUSIONS: usize = 8;

/// What a step needs besides the gradients.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct VertexStep {
    /// Number of this step, from 1.
    pub(crate) number: u32,
    /// Approximate largest movement of a vertex, pixels.
    pub(crate) rate: f32,
}

/// State of the vertices in a checkpoint besides their positions. Fixed when the vertices were freed: a resumed run
/// must not measure surfaces that have moved since.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct VertexState {
    /// Size of a pixel on the meshes, world units, as steps are given in pixels.
    pub(crate) pixel: f32,
    /// Directions of movement, `[V·3]`.
    pub(crate) normals: Vec<f32>,
    /// Adam's first and second moments, `[V·2]`.
    pub(crate) moments: Vec<f32>,
}

impl VertexState {
    /// State with the meshes' normals and moments of zero.
    pub(crate) fn new(meshes: &[Mesh], pixel: f32) -> Self {
        let normals: Vec<Vec3> =
            meshes.iter().flat_map(|m| geometry::vertex_normals(m.positions(), m.triangles())).collect();
        Self { pixel, moments: vec![0.0; 2 * normals.len()], normals: bytemuck::cast_slice(&normals).to_vec() }
    }
}

/// Buffers and kernels of moving vertices.
pub(crate) struct Vertices {
    count: usize,
    pixel: f32,
    gradient: Buffer,
    moments: Buffer,
    normals: Buffer,
    corner_normals: Buffer,
    step: Buffer,
    /// Kernels for gradients of fragments, their peak, and sums.
    backward: [Kernel; 3],
    /// Stages start, diffuse even, diffuse odd, displace.
    moving: [Stage; 4],
}

impl Vertices {
    /// Stages for the vertices of `meshes`, whose `positions` `[V, 3]` are moved; `defines` are those of the mesh
    /// stage.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn new(
        gpu: &Gpu,
        defines: &Defines,
        meshes: &[Mesh],
        positions: &Buffer,
        [status, peaks]: [&Buffer; 2],
        state: &VertexState,
    ) -> Result<Self, GpuError> {
        let count = state.normals.len() / 3;
        let (mut triangles, mut first_vertex) = (vec![], 0);
        for mesh in meshes {
            triangles.extend(mesh.triangles().iter().map(|t| t.map(|v| first_vertex + v)));
            first_vertex += mesh.positions().len() as u32;
        }
        let normal = |v: u32| {
            let n = &state.normals[3 * v as usize..][..3];
            [n[0].to_bits(), n[1].to_bits(), n[2].to_bits(), v]
        };
        let corner_normals: Vec<[u32; 4]> = triangles.iter().flatten().map(|&v| normal(v)).collect();
        let padded: Vec<[u32; 4]> = (0..count as u32).map(normal).collect();
        let rings = Rings::new(count, &triangles);
        let gradient = gpu.storage("vertex gradients", 2 * count)?;
        let moments = gpu.storage_with("vertex moments", &state.moments)?;
        let normals = gpu.storage_with("vertex normals", &padded)?;
        let steps = gpu.storage("vertex steps", 4 * count)?;
        let first = gpu.storage_with("rings of vertices", &rings.first)?;
        let neighbors = gpu.storage_with("neighbours of vertices", &rings.of)?;
        let step = gpu.uniform("vertex step", 4)?;
        let buffers = [&step, &gradient, &moments, &steps, &first, &neighbors, &normals, positions, status, peaks];
        let moving = [("start", 0), ("diffuse", 0), ("diffuse", 1), ("displace", 0)].map(|(entry, odd)| {
            Stage::new(gpu, "move_vertices.wgsl", entry, &adam::defines(gpu).with("ODD", odd), &buffers)
        });
        let backward = [
            Kernel::new(gpu, "uv_backward.wgsl", "backward", defines),
            peak_kernel(gpu, defines, 1),
            Kernel::new(gpu, "vertex_backward.wgsl", "backward", defines),
        ];
        let corner_normals = gpu.storage_with("corner normals", &corner_normals)?;
        Ok(Self { count, pixel: state.pixel, gradient, moments, normals, corner_normals, step, backward, moving })
    }

    /// Binds the backward kernels: `fragment` are the buffers of `shaders/shared/mesh_fragment.wgsl`, `texels` those of
    /// the base and, if there are any, of the bands.
    pub(crate) fn bind(
        &self,
        gpu: &Gpu,
        fragment: &[&Buffer; 5],
        (base, bands): (&Buffer, Option<&Buffer>),
        [layer_gradient, peaks]: [&Buffer; 2],
    ) -> [Stage; 3] {
        let mut of_fragments = fragment.to_vec();
        of_fragments.extend([base, layer_gradient, &self.corner_normals]);
        of_fragments.extend(bands);
        let [view, triangles, ..] = *fragment;
        let peak = [view, triangles, layer_gradient, peaks];
        let sums = [view, triangles, layer_gradient, &self.corner_normals, peaks, &self.gradient];
        let [k0, k1, k2] = &self.backward;
        [k0.bind(gpu, &of_fragments), k1.bind(gpu, &peak), k2.bind(gpu, &sums)]
    }

    /// Appends the gradients of all vertices; the layers' gradient is overwritten.
    pub(crate) fn record_backward(&self, frame: &mut Frame, stages: &[Stage; 3], fragments: usize) {
        frame.clear(&self.gradient);
        for (stage, per_thread) in stages.iter().zip([1, PEAK_FRAGMENTS, 1]) {
            frame.dispatch_threads(stage, groups(fragments, per_thread));
        }
    }

    /// Parameters of the next step; takes effect before the next submission.
    pub(crate) fn set_step(&self, gpu: &Gpu, step: &VertexStep) {
        let [first, second] = bias_corrections(step.number).map(f32::to_bits);
        let words = [(step.rate * self.pixel).to_bits(), first, second, self.count as u32];
        gpu.write(&self.step, 0, &words);
    }

    /// Appends a step of all vertices.
    pub(crate) fn record_step(&self, frame: &mut Frame) {
        let [start, even, odd, done] = &self.moving;
        let diffusions = (0..DIFFUSIONS).flat_map(|_| [even, odd]);
        for stage in [start].into_iter().chain(diffusions).chain([done]) {
            frame.dispatch_threads(stage, self.count);
        }
    }

    /// Gradients along the normals, `[V]`. Waits.
    ///
    /// # Errors
    /// If the driver failed.
    #[cfg(test)]
    pub(crate) fn read_gradient(&self, gpu: &Gpu, peaks: &Buffer) -> Result<Vec<f32>, GpuError> {
        let unit = gpu.read::<f32>(peaks, PEAKS)?[1] / FIXED_ONE;
        let sums = gpu.read::<[u32; 2]>(&self.gradient, self.count)?;
        let sum = |[low, high]: [u32; 2]| (u64::from(high) << 32 | u64::from(low)).cast_signed();
        Ok(sums.into_iter().map(|words| unit * sum(words) as f32).collect())
    }

    /// Reads the state for a checkpoint. Waits.
    ///
    /// # Errors
    /// If the driver failed.
    pub(crate) fn read_state(&self, gpu: &Gpu) -> Result<VertexState, GpuError> {
        let padded: Vec<[f32; 4]> = gpu.read(&self.normals, self.count)?;
        let normals = padded.iter().flat_map(|n| [n[0], n[1], n[2]]).collect();
        Ok(VertexState { pixel: self.pixel, normals, moments: gpu.read(&self.moments, 2 * self.count)? })
    }
}

#[cfg(test)]
mod tests;
