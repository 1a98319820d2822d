//! Mesh layers by compute: the L nearest fragments per pixel, their colour and alpha, and the backward pass from the
//! gradient of these to the texels.
//!
//! Forward: `setup_triangles` → `bin_triangles` (count, scan, scatter) → `raster_layers` → `shade_layers`.
//! Backward: zero → `gradient_peak` → `texel_backward` (`texel_backward_serial` on software adapters); then
//! `adam_texels` → `build_mips`. Without meshes nothing is dispatched.

use super::device::{Buffer, Frame, Gpu, GpuError, Kernel, Stage, groups};
use super::shader::Defines;
#[cfg(test)]
use super::texels::AtlasGradient;
use super::texels::{PEAK_FRAGMENTS, TexelStep, Texels, peak_kernel};
use super::vertices::{VertexState, VertexStep, Vertices};
use super::view::View;
use crate::scene::{Atlas, Camera, Intrinsics, Mesh};

/// Side in pixels of the square bins that triangles are sorted into. Smaller than the splats' tiles: the triangles of
/// a dense mesh are a few pixels large, and every triangle is tested at every pixel of its bins.
pub(crate) const BIN: u32 = 8;

/// Meshes on the adapter, and per-pixel layers of the last rendered view.
pub(crate) struct MeshStage {
    layers: u32,
    n_triangles: usize,
    geometry: Geometry,
    texels: Texels,
    vertices: Option<Vertices>,
    kernels: Kernels,
    screen: Screen,
    /// Bound to `screen`; `None` until there is room for a view.
    stages: Option<Stages>,
    /// Of the view that frames are recorded for; `None` before the first.
    extent: Option<Extent>,
    generation: u64,
    layer_generation: u64,
    trainable: bool,
}

/// Buffers that do not depend on the view's size. Bytes per triangle: 16 + 32 + 48 + 8, and 12 per vertex.
struct Geometry {
    positions: Buffer,
    triangles: Buffer,
    corner_uvs: Buffer,
    corners: Buffer,
    boxes: Buffer,
    maps: Buffer,
    pairs_needed: Buffer,
}

/// Buffers that depend on the view's size. Bytes per pixel and layer: 24 to render, 16 more to train; 8 per bin; 4 per
/// pair.
struct Screen {
    pixels: usize,
    bins: usize,
    capacity: usize,
    bin_fill: Buffer,
    bin_start: Buffer,
    pairs: Buffer,
    layer_triangle: Buffer,
    layer_depth: Buffer,
    layer_color: Buffer,
    layer_gradient: Buffer,
}

struct Kernels {
    setup: Kernel,
    count: Kernel,
    scan: Kernel,
    scatter: Kernel,
    raster: Kernel,
    shade: Kernel,
    peak: Kernel,
    backward: Kernel,
}

/// Sizes of the dispatches for a view.
#[derive(Clone, Copy)]
struct Extent {
    bins: usize,
    /// Threads that process the triangles' bins.
    binning_threads: usize,
    /// Pixels of all layers.
    fragments: usize,
    /// Threads of the texel gradients for all layers.
    texel_threads: usize,
}

struct Stages {
    setup: Stage,
    count: Stage,
    scan: Stage,
    scatter: Stage,
    raster: Stage,
    shade: Stage,
    /// Largest gradient, then the gradients of texels.
    backward: Option<[Stage; 2]>,
    vertices: Option<[Stage; 3]>,
}

/// Kernel of the texel gradients, the pixels, across and down, that a group of its threads takes, and the number of
/// these threads. On a software adapter atomic additions take each lane in turn, so a thread adds to a texel once for
/// all pixels of a column; hardware wants the threads.
fn texel_backward(gpu: &Gpu) -> (&'static str, [u32; 2], u32) {
    if gpu.profile().is_cpu { ("texel_backward_serial.wgsl", [1, 32], 1) } else { ("texel_backward.wgsl", [8, 8], 64) }
}

/// Largest number of a picture's bins that one thread processes for a triangle. A GPU has no hard limit, but the thread
/// waits for an addition in each bin: a wall of two triangles would hold up the frame.
fn most_bins(gpu: &Gpu) -> usize {
    gpu.loop_passes().map_or(4096, |passes| passes / 4 * 3)
}

/// Most threads that process the triangles' bins. Their numbers, including those that fill up the last row of a
/// dispatch, have 32 bits.
const MOST_BINNING_THREADS: usize = 1 << 31;

/// Number of threads among which the rows of each triangle are divided, `most_bins` of a picture's bins to each. For
/// very many triangles in a very large picture there are fewer, with more bins to each; Mesa's software adapter, where
/// that may be too many ([`Gpu::loop_passes`]), cannot bind lists of so many triangles.
pub(super) fn binning_shares(triangles: usize, bins: usize, most_bins: usize) -> usize {
    bins.div_ceil(most_bins).min(MOST_BINNING_THREADS / triangles.max(1)).max(1)
}

/// Number of bins of a picture.
fn bins(k: &Intrinsics) -> usize {
    k.width.div_ceil(BIN) as usize * k.height.div_ceil(BIN) as usize
}

impl Extent {
    /// Extent of a picture with `layers` layers of `triangles` triangles.
    fn new(gpu: &Gpu, k: &Intrinsics, layers: u32, triangles: usize) -> Self {
        let (_, [w, h], threads) = texel_backward(gpu);
        let of_layer = threads as usize * k.width.div_ceil(w) as usize * k.height.div_ceil(h) as usize;
        let (bins, layers) = (bins(k), layers as usize);
        Self {
            bins,
            binning_threads: triangles * binning_shares(triangles, bins, most_bins(gpu)),
            fragments: layers * k.pixels(),
            texel_threads: layers * of_layer,
        }
    }
}

impl Geometry {
    fn new(gpu: &Gpu, meshes: &[Mesh], table: &[u32]) -> Result<Self, GpuError> {
        let (mut positions, mut triangles, mut uvs) = (vec![], vec![], vec![]);
        for (m, mesh) in meshes.iter().enumerate() {
            let first = (positions.len() / 3) as u32;
            positions.extend(mesh.positions().iter().flat_map(glam::Vec3::to_array));
            triangles.extend(mesh.triangles().iter().map(|t| [first + t[0], first + t[1], first + t[2], 0]));
            let record = |c: &[glam::Vec2; 3]| {
                let uv = |k: usize| c[k].to_array().map(f32::to_bits);
                let ([u0, v0], [u1, v1], [u2, v2]) = (uv(0), uv(1), uv(2));
                [u0, v0, u1, v1, u2, v2, m as u32, 0]
            };
            uvs.extend(mesh.corner_uvs().iter().map(record));
        }
        Ok(Self {
            positions: gpu.storage_with("mesh positions", &positions)?,
            triangles: gpu.storage_with("mesh triangles", &triangles)?,
            corner_uvs: gpu.storage_with("mesh corner UVs", &uvs)?,
            corners: gpu.storage("mesh corners", 12 * triangles.len())?,
            boxes: gpu.storage("mesh bin boxes", 2 * triangles.len())?,
            maps: gpu.storage_with("mesh maps", table)?,
            pairs_needed: gpu.storage("mesh pairs needed", 1)?,
        })
    }
}

impl Screen {
    fn new(gpu: &Gpu, layers: u32, pixels: usize, bins: usize, capacity: usize, train: bool) -> Result<Self, GpuError> {
        let fragments = layers as usize * pixels;
        Ok(Self {
            pixels,
            bins,
            capacity,
            bin_fill: gpu.storage("mesh bin counts", bins)?,
            bin_start: gpu.storage("mesh bin offsets", bins)?,
            pairs: gpu.storage("mesh (bin, triangle) pairs", capacity)?,
            layer_triangle: gpu.storage("mesh layer triangles", fragments)?,
            layer_depth: gpu.storage("mesh layer depths", fragments)?,
            layer_color: gpu.storage("mesh layer colours", 4 * fragments)?,
            layer_gradient: gpu.storage("mesh layer gradients", if train { 4 * fragments } else { 0 })?,
        })
    }
}

impl Kernels {
    fn new(gpu: &Gpu, layers: u32, texels: &Texels) -> Self {
        // On a software adapter a lane is a loop iteration and workgroup memory is plain memory: a thread that owns
        // many pixels saves loads. Hardware wants the lanes.
        let per_thread: u32 = if gpu.profile().is_cpu { 8 } else { 1 };
        assert!((BIN * BIN).is_multiple_of(per_thread), "threads share out a bin without rest");
        let (backward, [across, down], _) = texel_backward(gpu);
        let defines: Defines = gpu
            .defines()
            .with("LAYERS", layers)
            .with("BANDS", texels.band_coefficients())
            .with("FOURS", u32::from(texels.bands_are_in_fours()))
            .with("ACROSS", across)
            .with("DOWN", down)
            .with("BIN", BIN)
            .with("MOST_BINS", most_bins(gpu) as u32)
            .with("MOST_BINNING_THREADS", MOST_BINNING_THREADS as u32)
            .with("PER_THREAD", per_thread)
            .with("THREADS", BIN * BIN / per_thread);
        let kernel = |file, entry| Kernel::new(gpu, file, entry, &defines);
        Self {
            setup: kernel("setup_triangles.wgsl", "setup"),
            count: kernel("bin_triangles.wgsl", "count"),
            scan: kernel("bin_triangles.wgsl", "scan"),
            scatter: kernel("bin_triangles.wgsl", "scatter"),
            raster: kernel("raster_layers.wgsl", "raster"),
            shade: kernel("shade_layers.wgsl", "shade"),
            peak: peak_kernel(gpu, &defines, 0),
            backward: kernel(backward, "backward"),
        }
    }
}

impl MeshStage {
    /// Uploads `meshes`. `layers` is 1, 2 or 4; a step's `status` adds the buffers of `record_backward` and
    /// `record_adam`.
    ///
    /// # Errors
    /// If a buffer exceeds what the adapter binds.
    pub(crate) fn new(gpu: &Gpu, meshes: &[Mesh], layers: u32, status: Option<&Buffer>) -> Result<Self, GpuError> {
        let trainable = status.is_some();
        let texels = Texels::new(gpu, meshes, status)?;
        let kernels = Kernels::new(gpu, layers, &texels);
        Ok(Self {
            layers,
            n_triangles: meshes.iter().map(|m| m.triangles().len()).sum(),
            geometry: Geometry::new(gpu, meshes, &texels.table())?,
            texels,
            vertices: None,
            kernels,
            screen: Screen::new(gpu, layers, 0, 0, 0, trainable)?,
            stages: None,
            extent: None,
            generation: 0,
            layer_generation: 0,
            trainable,
        })
    }

    /// Number of times that buffers of the layers or of [`Self::pairs`] were replaced: what is bound to those of
    /// another generation is out of date.
    pub(crate) fn generation(&self) -> u64 {
        self.generation
    }

    /// Number of times that buffers of the layers were replaced, likewise.
    pub(crate) fn layer_generation(&self) -> u64 {
        self.layer_generation
    }

    /// Makes room for pictures of these cameras. `view_uniform` must be the same buffer in every call. Buffers only
    /// grow.
    ///
    /// # Errors
    /// If a buffer exceeds what the adapter binds.
    pub(crate) fn make_room(&mut self, gpu: &Gpu, cameras: &[Camera], view_uniform: &Buffer) -> Result<(), GpuError> {
        if self.n_triangles == 0 {
            return Ok(());
        }
        let sizes = cameras.iter().map(|camera| (camera.intrinsics().pixels(), bins(camera.intrinsics())));
        let (pixels, bins) = sizes.fold((0, 0), |most, size| (most.0.max(size.0), most.1.max(size.1)));
        let grow = self.stages.is_none() || pixels > self.screen.pixels || bins > self.screen.bins;
        if grow {
            let (pixels, bins) = (pixels.max(self.screen.pixels), bins.max(self.screen.bins));
            // A triangle of a dense mesh is in one to four bins; large ones fill the screen a few times over.
            let capacity =
                (4 * self.n_triangles + 16 * bins).min(gpu.max_binding_bytes() as usize / 4).max(self.screen.capacity);
            self.screen = Screen::new(gpu, self.layers, pixels, bins, capacity, self.trainable)?;
            self.generation += 1;
            self.layer_generation += 1;
            self.stages = Some(self.bind(gpu, view_uniform));
        }
        Ok(())
    }

    /// As [`Self::make_room`] for a view, which sets the size of frames recorded from now on.
    ///
    /// # Errors
    /// If a buffer exceeds what the adapter binds.
    pub(crate) fn resize(&mut self, gpu: &Gpu, view: &View, view_uniform: &Buffer) -> Result<(), GpuError> {
        self.make_room(gpu, &[view.camera], view_uniform)?;
        self.extent = Some(Extent::new(gpu, view.camera.intrinsics(), self.layers, self.n_triangles));
        Ok(())
    }

    /// Largest number of (bin, triangle) pairs that a frame has needed; frames that needed more than the capacity lack
    /// triangles. Waits.
    ///
    /// # Errors
    /// If the driver failed.
    pub(crate) fn pairs_needed(&self, gpu: &Gpu) -> Result<usize, GpuError> {
        Ok(gpu.read::<u32>(&self.geometry.pairs_needed, 1)?[0] as usize)
    }

    /// Capacity for (bin, triangle) pairs.
    pub(crate) fn pair_capacity(&self) -> usize {
        self.screen.capacity
    }

    /// Buffers `array<u32>` `[1]` of the most pairs that a view needed, and of the pairs themselves.
    pub(crate) fn pairs(&self) -> [&Buffer; 2] {
        [&self.geometry.pairs_needed, &self.screen.pairs]
    }

    /// Makes room for at least this many pairs.
    ///
    /// # Errors
    /// If the list exceeds what the adapter binds.
    pub(crate) fn lengthen(&mut self, gpu: &Gpu, view_uniform: &Buffer, pairs: usize) -> Result<(), GpuError> {
        if pairs > self.screen.capacity {
            self.screen.pairs = gpu.storage("mesh (bin, triangle) pairs", pairs)?;
            self.screen.capacity = pairs;
            self.generation += 1;
            self.rebind(gpu, view_uniform);
        }
        Ok(())
    }

    /// Binds the stages anew, if there are any.
    fn rebind(&mut self, gpu: &Gpu, view: &Buffer) {
        if self.stages.is_some() {
            self.stages = Some(self.bind(gpu, view));
        }
    }

    fn bind(&self, gpu: &Gpu, view: &Buffer) -> Stages {
        let (g, s, t, k) = (&self.geometry, &self.screen, &self.texels, &self.kernels);
        let bin = [view, &g.corners, &g.boxes, &s.bin_fill, &s.bin_start, &s.pairs, &g.pairs_needed];
        let fragment = [view, &s.layer_triangle, &g.corners, &g.corner_uvs, &g.maps];
        let shade = [t.base(), t.bands(), &s.layer_color];
        let backward = t.gradients().map(|(base, bands)| {
            let both = [&s.layer_color, &s.layer_gradient, t.peaks(), base, bands];
            let own = if t.band_coefficients() > 0 { &both[..] } else { &both[..4] };
            let peak = k.peak.bind(gpu, &[&fragment[..], &[&s.layer_gradient, t.peaks()]].concat());
            [peak, k.backward.bind(gpu, &[&fragment[..], own].concat())]
        });
        let raster = [view, &g.corners, &s.bin_start, &s.bin_fill, &s.pairs, &s.layer_depth, &s.layer_triangle];
        Stages {
            setup: k.setup.bind(gpu, &[view, &g.positions, &g.triangles, &g.corners, &g.boxes]),
            count: k.count.bind(gpu, &bin),
            scan: k.scan.bind(gpu, &bin),
            scatter: k.scatter.bind(gpu, &bin),
            raster: k.raster.bind(gpu, &raster),
            shade: k.shade.bind(gpu, &[&fragment[..], &shade].concat()),
            backward,
            vertices: self.vertices.as_ref().map(|v| {
                let bands = (t.band_coefficients() > 0).then(|| t.bands());
                v.bind(gpu, &fragment, (t.base(), bands), [&s.layer_gradient, t.peaks()])
            }),
        }
    }

    /// Enables gradients by the vertices in `record_backward`, and their movement. `status` is that of the step.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn free_vertices(
        &mut self,
        gpu: &Gpu,
        meshes: &[Mesh],
        view_uniform: &Buffer,
        status: &Buffer,
        state: &VertexState,
    ) -> Result<(), GpuError> {
        let defines = gpu.defines().with("LAYERS", self.layers).with("BANDS", self.texels.band_coefficients());
        let besides = [status, self.texels.peaks()];
        self.vertices = Some(Vertices::new(gpu, &defines, meshes, &self.geometry.positions, besides, state)?);
        self.rebind(gpu, view_uniform);
        Ok(())
    }

    /// The vertices, if they are free to move.
    pub(crate) fn vertices(&self) -> Option<&Vertices> {
        self.vertices.as_ref()
    }

    /// Positions of all vertices, mesh by mesh. Waits.
    ///
    /// # Errors
    /// If the driver failed.
    pub(crate) fn read_positions(&self, gpu: &Gpu, count: usize) -> Result<Vec<glam::Vec3>, GpuError> {
        let floats: Vec<f32> = gpu.read(&self.geometry.positions, 3 * count)?;
        Ok(floats.chunks_exact(3).map(glam::Vec3::from_slice).collect())
    }

    /// Moves free vertices by a step.
    pub(crate) fn record_vertex_step(&self, gpu: &Gpu, frame: &mut Frame, step: &VertexStep) {
        if let Some(vertices) = &self.vertices {
            vertices.set_step(gpu, step);
            vertices.record_step(frame);
        }
    }

    /// Layers per pixel.
    pub(crate) fn layers(&self) -> u32 {
        self.layers
    }

    /// Triangles of all meshes.
    pub(crate) fn n_triangles(&self) -> u32 {
        self.n_triangles as u32
    }

    /// `array<u32>` `[layers, h, w]`: index + 1 of the triangle, 0 = empty.
    pub(crate) fn layer_triangle(&self) -> &Buffer {
        &self.screen.layer_triangle
    }

    /// `array<vec4f>` `[F, 3]`: camera-space corners for the view that was rendered last.
    pub(crate) fn corners(&self) -> &Buffer {
        &self.geometry.corners
    }

    /// `array<f32>` `[layers, h, w]`: camera-space z, nearest layer first, 0 = empty.
    pub(crate) fn layer_depth(&self) -> &Buffer {
        &self.screen.layer_depth
    }

    /// `array<vec4f>` `[layers, h, w]`: rgb ≥ 0, alpha ≤ 1 − 1e-4; 0 where empty.
    pub(crate) fn layer_color(&self) -> &Buffer {
        &self.screen.layer_color
    }

    /// `array<vec4f>` `[layers, h, w]`: gradient of the loss by `layer_color`, written by the blend's backward pass.
    pub(crate) fn layer_gradient(&self) -> &Buffer {
        &self.screen.layer_gradient
    }

    /// Index + 1 of the nearest triangle at each of the first `pixels` pixels of the last rendered view; 0 if there is
    /// none.
    ///
    /// # Errors
    /// If the driver failed.
    pub(crate) fn read_front_triangles(&self, gpu: &Gpu, pixels: usize) -> Result<Vec<u32>, GpuError> {
        gpu.read(&self.screen.layer_triangle, pixels)
    }

    /// Stages and sizes of their dispatches, once there is a view.
    fn bound(&self) -> Option<(&Stages, Extent)> {
        self.stages.as_ref().zip(self.extent)
    }

    /// Appends depths and colours of all layers for the view in the uniform.
    pub(crate) fn record_forward(&self, frame: &mut Frame) {
        let Some((stages, extent)) = self.bound() else { return };
        frame.dispatch_threads(&stages.setup, self.n_triangles);
        frame.dispatch_threads(&stages.count, extent.binning_threads);
        frame.dispatch(&stages.scan, 1);
        frame.dispatch_threads(&stages.scatter, extent.binning_threads);
        frame.dispatch(&stages.raster, extent.bins);
        frame.dispatch_threads(&stages.shade, extent.fragments);
    }

    /// Appends the gradients of all texels from `layer_gradient`; nothing unless trainable.
    pub(crate) fn record_backward(&self, frame: &mut Frame) {
        let Some((Stages { backward: Some([peak, texels]), .. }, extent)) = self.bound() else { return };
        self.texels.record_zero_gradients(frame);
        frame.dispatch_threads(peak, groups(extent.fragments, PEAK_FRAGMENTS));
        frame.dispatch_threads(texels, extent.texel_threads);
    }

    /// Appends the gradients of free vertices from `layer_gradient`, which is overwritten, and the maps as rendered;
    /// after `record_backward`.
    pub(crate) fn record_vertex_backward(&self, frame: &mut Frame) {
        let Some((Stages { vertices: Some(stages), .. }, extent)) = self.bound() else { return };
        if let Some(free) = &self.vertices {
            free.record_backward(frame, stages, extent.fragments);
        }
    }

    /// Parameters of the next Adam step; takes effect before the next submission.
    pub(crate) fn set_step(&self, gpu: &Gpu, step: &TexelStep) {
        self.texels.set_step(gpu, step);
    }

    /// Appends a step of Adam on the texels, and the rebuilding of their mips.
    pub(crate) fn record_adam(&self, frame: &mut Frame) {
        self.texels.record_adam(frame);
    }

    /// Reads the maps, one atlas per mesh. Waits.
    ///
    /// # Errors
    /// If the driver failed or a texel is not finite.
    pub(crate) fn read_atlases(&self, gpu: &Gpu) -> Result<Vec<Atlas>, GpuError> {
        self.texels.read_atlases(gpu)
    }

    /// Gradients of the last backward pass, per mesh; empty if not trainable.
    ///
    /// # Errors
    /// If the driver failed.
    #[cfg(test)]
    pub(crate) fn read_gradients(&self, gpu: &Gpu) -> Result<Vec<AtlasGradient>, GpuError> {
        self.texels.read_gradients(gpu)
    }

    /// Gradients of free vertices along their normals, `[V]`; empty if there are none.
    ///
    /// # Errors
    /// If the driver failed.
    #[cfg(test)]
    pub(crate) fn read_vertex_gradient(&self, gpu: &Gpu) -> Result<Vec<f32>, GpuError> {
        self.vertices.as_ref().map_or(Ok(vec![]), |v| v.read_gradient(gpu, self.texels.peaks()))
    }

    /// Adam's moments (first, second): base maps of all meshes, then bands of all meshes. Empty if not trainable.
    ///
    /// # Errors
    /// If the driver failed.
    pub(crate) fn read_moments(&self, gpu: &Gpu) -> Result<(Vec<f32>, Vec<f32>), GpuError> {
        self.texels.read_moments(gpu)
    }

    /// Restores moments of `read_moments`; false, and nothing changes, if they belong to other meshes.
    pub(crate) fn write_moments(&self, gpu: &Gpu, first: &[f32], second: &[f32]) -> bool {
        self.texels.write_moments(gpu, first, second)
    }
}
