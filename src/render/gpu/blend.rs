//! The blend of splats and mesh layers and its gradients: `blend_forward.wgsl`, `blend_backward.wgsl`.

use super::{
    device::{Bindings, Buffer, Frame, Gpu, GpuError, Kernel},
    shader::Defines,
    splats::{ImageCapacity, SplatLists},
};

/// Sums per splat that `blend_backward.wgsl` accumulates.
pub(crate) const MOMENTS: usize = 10;

/// Depth and colour of the mesh layers, and where their gradient goes.
#[derive(Clone, Copy)]
pub(crate) struct LayerBuffers<'a> {
    pub(crate) depth: &'a Buffer,
    pub(crate) color: &'a Buffer,
    pub(crate) gradient: &'a Buffer,
}

/// Forward blend into an image.
pub(crate) struct Blend {
    /// `[h·w]` vec4: rgb, final transmittance.
    pub(crate) image: Buffer,
    forward: (Kernel, Bindings),
    backward: Option<Backward>,
}

struct Backward {
    kernel: Kernel,
    bindings: Bindings,
    moments: Buffer,
}

/// Threads and pixels per thread. A software adapter reads workgroup memory lane by lane, so there a splat's record
/// is read once for four pixels; wide hardware prefers more threads.
fn shape(gpu: &Gpu) -> (u32, u32) {
    if gpu.profile().is_cpu { (64, 4) } else { (256, 1) }
}

impl Blend {
    /// Buffers and kernels; with `gradient` (`[h·w]` vec4, ∂L/∂rgb) also for the backward pass over `n` splats.
    pub(crate) fn new(
        gpu: &Gpu,
        lists: &SplatLists,
        image: ImageCapacity,
        view: &Buffer,
        layers: Option<LayerBuffers>,
        training: Option<(&Buffer, usize)>,
    ) -> Result<Self, GpuError> {
        let (threads, per_thread) = shape(gpu);
        let n_layers = lists.layers();
        let defines = gpu
            .defines()
            .with("LAYERS", n_layers)
            .with("BUCKETS", n_layers + 1)
            .with("THREADS", threads)
            .with("PER_THREAD", per_thread)
            .with("SAVE", u32::from(training.is_some()));
        let pixels = gpu.storage("image", image.pixels * 4)?;
        let kernel = Kernel::new(gpu, "blend_forward.wgsl", "main", &defines);
        let Some((gradient, n)) = training else {
            let mut buffers = vec![view, &lists.ranges, lists.pair_splats(), &lists.projected, &pixels];
            if let Some(l) = layers {
                buffers.extend([&lists.thresholds, l.depth, l.color]);
            }
            let bindings = kernel.bind(gpu, &buffers);
            return Ok(Self { image: pixels, forward: (kernel, bindings), backward: None });
        };

        let n_buckets = n_layers as usize + 1;
        let buckets = gpu.storage("blend buckets", image.pixels * 4 * n_buckets)?;
        let ends = gpu.storage("blend ends", image.pixels * n_buckets)?;
        let mut buffers = vec![view, &lists.ranges, lists.pair_splats(), &lists.projected, &pixels, &buckets, &ends];
        if let Some(l) = layers {
            buffers.extend([&lists.thresholds, l.depth, l.color]);
        }
        let bindings = kernel.bind(gpu, &buffers);
        let moments = gpu.storage("splat moments", n.max(1) * MOMENTS)?;
        let backward = Kernel::new(gpu, "blend_backward.wgsl", "main", &with_chunk(gpu, defines, threads));
        let mut buffers =
            vec![view, &lists.ranges, lists.pair_splats(), &lists.projected, gradient, &buckets, &ends, &moments];
        if let Some(l) = layers {
            buffers.extend([&lists.thresholds, l.depth, l.color, l.gradient]);
        }
        let backward_bindings = backward.bind(gpu, &buffers);
        Ok(Self {
            image: pixels,
            forward: (kernel, bindings),
            backward: Some(Backward { kernel: backward, bindings: backward_bindings, moments }),
        })
    }

    /// Appends the forward blend of `tiles` tiles.
    pub(crate) fn record_forward(&self, frame: &mut Frame, tiles: usize) {
        frame.dispatch(&self.forward.0, &self.forward.1, tiles);
    }

    /// Appends the backward blend; does nothing if not made for training.
    pub(crate) fn record_backward(&self, frame: &mut Frame, tiles: usize) {
        if let Some(b) = &self.backward {
            frame.clear(&b.moments);
            frame.dispatch(&b.kernel, &b.bindings, tiles);
        }
    }

    /// `[n][10]` sums per splat, if made for training.
    pub(crate) fn moments(&self) -> Option<&Buffer> {
        self.backward.as_ref().map(|b| &b.moments)
    }
}

/// Splats per chunk of the backward pass: 8 take 16 KiB for their pairs, besides at most 16 KiB of other arrays.
fn with_chunk(gpu: &Gpu, defines: Defines, threads: u32) -> Defines {
    let roomy = gpu.workgroup_bytes() >= 32 * 1024 && (gpu.profile().subgroups || threads <= 64);
    defines.with("CHUNK", if roomy { 8 } else { 4 })
}
