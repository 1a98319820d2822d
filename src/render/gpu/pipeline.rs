//! One frame, forward and backward: which stage runs when, on which buffers.

use super::{
    blend::Blend,
    device::{Bindings, Buffer, Frame, Gpu, GpuError, Kernel, groups},
    splats::{GEOMETRY, ImageCapacity, SplatBuffers, SplatLists},
    view::{VIEW_WORDS, View},
};
use crate::scene::{Camera, Composition, HybridScene, sh};

/// (tile, splat) pairs that fit at first, per splat; grown when a frame needs more.
const PAIRS_PER_SPLAT: usize = 4;

/// Everything that one view's frame reads and writes.
pub(crate) struct Pipeline {
    pub(crate) view: Buffer,
    pub(crate) splats: SplatBuffers,
    pub(crate) n_splats: usize,
    pub(crate) lists: SplatLists,
    pub(crate) blend: Blend,
    pub(crate) composition: Composition,
    pub(crate) backward: Option<Backward>,
    image: ImageCapacity,
}

/// Gradients of the splats' parameters.
pub(crate) struct Backward {
    /// `[h·w]` vec4: ∂L/∂rgb of the image, written by the loss.
    pub(crate) image_gradient: Buffer,
    /// As `SplatBuffers::geometry`.
    pub(crate) geometry_gradient: Buffer,
    /// As `SplatBuffers::sh`.
    pub(crate) sh_gradient: Buffer,
    /// `[capacity]` vec4, see `splat_backward.wgsl`.
    pub(crate) statistics: Buffer,
    kernel: Kernel,
    bindings: Bindings,
}

impl Pipeline {
    /// A pipeline for the scene at images up to `sizes`.
    pub(crate) fn new(
        gpu: &Gpu,
        scene: &HybridScene,
        capacity: usize,
        image: ImageCapacity,
        trainable: bool,
    ) -> Result<Self, GpuError> {
        let view = gpu.uniform("view", VIEW_WORDS)?;
        let splats = SplatBuffers::new(gpu, capacity.max(scene.splats.len()), scene.splats.sh_degree())?;
        splats.write(gpu, &scene.splats);
        let pairs = splats.capacity * PAIRS_PER_SPLAT + image.tiles;
        let lists = SplatLists::new(gpu, &splats, image, pairs, &view, None)?;
        let image_gradient = if trainable { Some(gpu.storage("image gradient", image.pixels * 4)?) } else { None };
        let training = image_gradient.as_ref().map(|g| (g, splats.capacity));
        let blend = Blend::new(gpu, &lists, image, &view, None, training)?;
        let backward = match image_gradient {
            None => None,
            Some(image_gradient) => Some(Backward::new(gpu, &view, &splats, &lists, &blend, image_gradient)?),
        };
        Ok(Self {
            view,
            n_splats: scene.splats.len(),
            splats,
            lists,
            blend,
            composition: scene.composition,
            backward,
            image,
        })
    }

    /// What the shaders are told of a view.
    pub(crate) fn view_of(&self, camera: &Camera) -> View {
        View {
            camera: *camera,
            composition: self.composition,
            n_splats: self.n_splats as u32,
            sh_degree: self.splats.sh_degree,
            band_degree: 0,
            n_triangles: 0,
            pair_capacity: self.lists.pair_capacity() as u32,
        }
    }

    /// Appends everything from parameters to the image.
    pub(crate) fn record_forward(&self, gpu: &Gpu, frame: &mut Frame, view: &View) {
        gpu.write(&self.view, 0, &view.words());
        self.lists.record(gpu, frame, self.n_splats);
        let (x, y) = view.tiles();
        self.blend.record_forward(frame, x as usize * y as usize);
    }

    /// Appends everything from the image gradient to parameter gradients; does nothing if not trainable.
    pub(crate) fn record_backward(&self, frame: &mut Frame, view: &View) {
        let Some(backward) = &self.backward else { return };
        let (x, y) = view.tiles();
        self.blend.record_backward(frame, x as usize * y as usize);
        frame.dispatch(&backward.kernel, &backward.bindings, groups(self.n_splats, 256));
    }

    /// Makes room for `pairs` (tile, splat) pairs.
    pub(crate) fn grow_pairs(&mut self, gpu: &Gpu, pairs: usize) -> Result<(), GpuError> {
        self.lists = SplatLists::new(gpu, &self.splats, self.image, pairs + pairs / 4, &self.view, None)?;
        self.rebind(gpu)
    }

    fn rebind(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        let old = self.backward.take();
        let training = old.as_ref().map(|b| (&b.image_gradient, self.splats.capacity));
        self.blend = Blend::new(gpu, &self.lists, self.image, &self.view, None, training)?;
        if let Some(old) = old {
            let gradient = old.image_gradient;
            self.backward = Some(Backward::new(gpu, &self.view, &self.splats, &self.lists, &self.blend, gradient)?);
        }
        Ok(())
    }
}

impl Backward {
    fn new(
        gpu: &Gpu,
        view: &Buffer,
        splats: &SplatBuffers,
        lists: &SplatLists,
        blend: &Blend,
        image_gradient: Buffer,
    ) -> Result<Self, GpuError> {
        let terms = sh::coefficients(splats.sh_degree);
        let kernel = Kernel::new(gpu, "splat_backward.wgsl", "main", &gpu.defines().with("SH_TERMS", terms as u32));
        let geometry_gradient = gpu.storage("geometry gradient", splats.capacity * GEOMETRY)?;
        let sh_gradient = gpu.storage("SH gradient", splats.capacity * 3 * terms)?;
        let statistics = gpu.storage("density statistics", splats.capacity * 4)?;
        let moments = blend.moments().expect("made for training");
        let bindings = kernel.bind(
            gpu,
            &[
                view,
                &splats.geometry,
                &splats.sh,
                &lists.projected,
                &lists.visible,
                moments,
                &geometry_gradient,
                &sh_gradient,
                &statistics,
            ],
        );
        Ok(Self { image_gradient, geometry_gradient, sh_gradient, statistics, kernel, bindings })
    }
}
