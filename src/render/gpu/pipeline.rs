//! One frame, forward and backward: which stage runs when, on which buffers.

use super::{
    blend::{Blend, Gradients, LayerBuffers, moments},
    device::{Bindings, Buffer, Frame, Gpu, GpuError, Kernel, groups},
    mesh::MeshStage,
    renderer::Picture,
    splats::{GEOMETRY, ImageCapacity, Purpose, SplatBuffers, SplatLists, longer_list, longest_list},
    status::status_buffer,
    view::{VIEW_WORDS, View},
};
use crate::render::contract::ImageModel;
use crate::scene::{Camera, Composition, HybridScene, Mesh, sh};

/// (tile, splat) pairs that fit at first, per splat; grown when a frame needs more.
pub(crate) const PAIRS_PER_SPLAT: usize = 6;

/// Everything that one view's frame reads and writes.
pub(crate) struct Pipeline {
    pub(crate) view: Buffer,
    pub(crate) splats: SplatBuffers,
    pub(crate) n_splats: usize,
    pub(crate) mesh: Option<MeshStage>,
    pub(crate) lists: SplatLists,
    pub(crate) blend: Blend,
    pub(crate) composition: Composition,
    pub(crate) backward: Option<Backward>,
    pub(crate) image: ImageCapacity,
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
    /// See `status.rs`.
    pub(crate) status: Buffer,
    /// `[capacity]` vec4, see `splat_backward.wgsl`, with [`Pipeline::differentiate_poses`].
    pub(crate) turn_gradient: Option<Buffer>,
    besides: Besides,
    capacity: usize,
    kernel: Kernel,
    bindings: Option<Bindings>,
}

/// What is found besides gradients of parameters.
#[derive(Clone, Copy, Default)]
struct Besides {
    /// The statistics hold absolute gradients.
    absolute: bool,
    /// Gradients by the pose.
    by_pose: bool,
}

impl Pipeline {
    /// A pipeline for the scene, up to `capacity` splats (at least those it has), seen by `cameras`.
    pub(crate) fn new(
        gpu: &Gpu,
        scene: &HybridScene,
        capacity: usize,
        cameras: &[Camera],
        trainable: bool,
    ) -> Result<Self, GpuError> {
        let capacity = capacity.max(scene.splats.len());
        let splats = SplatBuffers::new(gpu, capacity, scene.splats.sh_degree())?;
        splats.write(gpu, &scene.splats);
        let mut built =
            Self::assemble(gpu, splats, &scene.meshes, scene.composition, cameras, splats_pairs(capacity), trainable)?;
        built.n_splats = scene.splats.len();
        Ok(built)
    }

    fn assemble(
        gpu: &Gpu,
        splats: SplatBuffers,
        meshes: &[Mesh],
        composition: Composition,
        cameras: &[Camera],
        pairs: usize,
        trainable: bool,
    ) -> Result<Self, GpuError> {
        let image = ImageCapacity::of(cameras.iter().map(|c| (c.intrinsics().width, c.intrinsics().height)));
        let view = gpu.uniform("view", VIEW_WORDS)?;
        let status = if trainable { Some(status_buffer(gpu)?) } else { None };
        let mut mesh = match meshes {
            [] => None,
            _ => Some(MeshStage::new(gpu, meshes, composition.layers, status.as_ref())?),
        };
        if let Some(mesh) = &mut mesh {
            for camera in cameras {
                let size = View::of(camera, composition);
                mesh.resize(gpu, &size, &view)?;
            }
        }
        let depth = mesh.as_ref().map(|m| (m.layer_depth(), composition.layers));
        let purpose = if trainable { Purpose::Train } else { Purpose::Render(ImageModel::Ewa) };
        let pairs = (pairs + image.tiles).min(longest_list(gpu));
        let lists = SplatLists::new(gpu, purpose, &splats, image, pairs, &view, depth)?;
        let image_gradient = if trainable { Some(gpu.storage("image gradient", image.pixels * 4)?) } else { None };
        let training =
            image_gradient.as_ref().map(|image| Gradients { image, capacity: splats.capacity, absolute: false });
        let blend = Blend::new(gpu, &lists, image, &view, layer_buffers(mesh.as_ref()), training)?;
        let backward = match image_gradient.zip(status) {
            None => None,
            Some(kept) => Some(Backward::new(gpu, &view, &splats, &lists, &blend, kept, Besides::default())?),
        };
        Ok(Self { view, n_splats: 0, splats, mesh, lists, blend, composition, backward, image })
    }

    /// Gets ready for a frame of this camera, one of those that the pipeline was made for or smaller, and says what
    /// the shaders are told of it.
    pub(crate) fn prepare(&mut self, gpu: &Gpu, camera: &Camera) -> Result<View, GpuError> {
        let splats = (self.n_splats, self.splats.sh_degree);
        let triangles = self.mesh.as_ref().map_or(0, MeshStage::n_triangles);
        let view = View::of_scene(camera, self.composition, splats, triangles, self.lists.pair_capacity());
        if let Some(mesh) = &mut self.mesh
            && mesh.resize(gpu, &view, &self.view)?
        {
            self.renew_lists(gpu, self.lists.pair_capacity())?;
        }
        Ok(view)
    }

    /// Appends everything from parameters to the image.
    pub(crate) fn record_forward(&self, gpu: &Gpu, frame: &mut Frame, view: &View) {
        gpu.write(&self.view, 0, &view.words());
        if let Some(mesh) = &self.mesh {
            mesh.record_forward(frame);
        }
        self.lists.record(gpu, frame, view.n_splats as usize);
        let (x, y) = view.tiles();
        self.blend.record_forward(frame, x as usize * y as usize);
    }

    /// Appends everything from the image gradient to parameter gradients; does nothing if not trainable.
    pub(crate) fn record_backward(&self, frame: &mut Frame, view: &View) {
        let Some(Backward { kernel, bindings: Some(bindings), .. }) = &self.backward else { return };
        let (x, y) = view.tiles();
        self.blend.record_backward(frame, x as usize * y as usize);
        frame.dispatch(kernel, bindings, groups(view.n_splats as usize, 256));
        if let Some(mesh) = &self.mesh {
            mesh.record_backward(frame);
        }
    }

    /// After a frame: enlarges lists that were too short for it. True if so, and the frame must be repeated.
    ///
    /// # Errors
    /// If the driver failed or the adapter cannot hold longer lists.
    pub(crate) fn grow_if_short(&mut self, gpu: &Gpu) -> Result<bool, GpuError> {
        let (_, pairs) = self.lists.read_counts(gpu)?;
        let mesh_grew = match &mut self.mesh {
            Some(mesh) => mesh.grow_if_short(gpu, &self.view)?,
            None => false,
        };
        let short = pairs > self.lists.pair_capacity();
        if short {
            self.renew_lists(gpu, longer_list(gpu, pairs))?;
        }
        Ok(short || mesh_grew)
    }

    /// Pixels of the largest image.
    pub(crate) fn pixels(&self) -> usize {
        self.image.pixels
    }

    /// Entries that the lists of (tile, splat) and (bin, triangle) pairs hold.
    pub(crate) fn list_lengths(&self) -> [usize; 2] {
        [self.lists.pair_capacity(), self.mesh.as_ref().map_or(0, MeshStage::pair_capacity)]
    }

    /// Makes the lists at least this long. True if they had to be made anew.
    ///
    /// # Errors
    /// If the adapter cannot hold them.
    pub(crate) fn lengthen_lists(&mut self, gpu: &Gpu, [splats, triangles]: [usize; 2]) -> Result<bool, GpuError> {
        let mesh_grew = match &mut self.mesh {
            Some(mesh) => mesh.lengthen(gpu, &self.view, triangles)?,
            None => false,
        };
        let short = splats > self.lists.pair_capacity();
        if short {
            self.renew_lists(gpu, splats)?;
        }
        Ok(short || mesh_grew)
    }

    /// From now on the statistics also hold absolute gradients, for AbsGS. What reads the image must be bound anew.
    pub(crate) fn sum_absolute_gradients(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        self.find_besides(gpu, |besides| besides.absolute = true)
    }

    /// From now on there are gradients by the pose of the camera, too, as far as splats depend on it. What reads the image must be
    /// bound anew.
    pub(crate) fn differentiate_poses(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        self.find_besides(gpu, |besides| besides.by_pose = true)
    }

    fn find_besides(&mut self, gpu: &Gpu, change: impl FnOnce(&mut Besides)) -> Result<(), GpuError> {
        let Some(backward) = &mut self.backward else { return Ok(()) };
        change(&mut backward.besides);
        let layers = layer_buffers(self.mesh.as_ref());
        self.blend = Blend::new(gpu, &self.lists, self.image, &self.view, layers, self.gradients())?;
        if let Some(mut backward) = self.backward.take() {
            backward.kernel = splat_kernel(gpu, &self.splats, backward.besides);
            backward.turn_gradient = turn_gradient(gpu, &self.splats, backward.besides)?;
            self.backward = Some(backward.bind(gpu, &self.view, &self.splats, &self.lists, &self.blend));
        }
        Ok(())
    }

    /// Floats of a splat in the moments of the blend.
    pub(crate) fn moments(&self) -> usize {
        self.backward.as_ref().map_or(0, |backward| moments(backward.besides.absolute))
    }

    fn gradients(&self) -> Option<Gradients<'_>> {
        let capacity = self.splats.capacity;
        self.backward.as_ref().map(|b| Gradients { image: &b.image_gradient, capacity, absolute: b.besides.absolute })
    }

    /// Makes the pipeline anew around other splat buffers (for more splats).
    pub(crate) fn replace_splats(&mut self, gpu: &Gpu, splats: SplatBuffers) -> Result<(), GpuError> {
        self.splats = splats;
        let pairs = splats_pairs(self.splats.capacity).min(longest_list(gpu));
        self.renew_lists(gpu, pairs.max(self.lists.pair_capacity()))
    }

    fn renew_lists(&mut self, gpu: &Gpu, pairs: usize) -> Result<(), GpuError> {
        let depth = self.mesh.as_ref().map(|m| (m.layer_depth(), self.composition.layers));
        let purpose = if self.backward.is_some() { Purpose::Train } else { Purpose::Render(ImageModel::Ewa) };
        self.lists = SplatLists::new(gpu, purpose, &self.splats, self.image, pairs, &self.view, depth)?;
        let layers = layer_buffers(self.mesh.as_ref());
        self.blend = Blend::new(gpu, &self.lists, self.image, &self.view, layers, self.gradients())?;
        if let Some(old) = self.backward.take() {
            self.backward = Some(if old.capacity == self.splats.capacity {
                old.bind(gpu, &self.view, &self.splats, &self.lists, &self.blend)
            } else {
                let kept = (old.image_gradient, old.status);
                Backward::new(gpu, &self.view, &self.splats, &self.lists, &self.blend, kept, old.besides)?
            });
        }
        Ok(())
    }

    /// The image of the last frame, which was of `camera`. Waits.
    pub(crate) fn read_picture(&self, gpu: &Gpu, camera: &Camera) -> Result<Picture, GpuError> {
        let k = camera.intrinsics();
        let words: Vec<[f32; 4]> = gpu.read(&self.blend.image, k.width as usize * k.height as usize)?;
        Ok(Picture {
            width: k.width,
            height: k.height,
            rgb: words.iter().map(|p| [p[0], p[1], p[2]]).collect(),
            transmittance: words.iter().map(|p| p[3]).collect(),
        })
    }

    /// Median depth of the splats alone in a view, `[h·w]`, 0 where there is none; `None` if lists were too short for it and are longer now:
    /// bind them anew wherever they are bound, and ask again.
    pub(crate) fn median_depth(&mut self, gpu: &Gpu, camera: &Camera) -> Result<Option<Vec<f32>>, GpuError> {
        let view = self.prepare(gpu, camera)?;
        let kernel = Kernel::new(gpu, "blend_depth.wgsl", "main", &gpu.defines());
        let depth = gpu.storage("median depth", view.pixels())?;
        let lists = &self.lists;
        let bindings = kernel.bind(
            gpu,
            &[&self.view, &lists.ranges, lists.pair_splats(), &lists.projected, &depth, &self.splats.geometry],
        );
        let mut frame = Frame::new(gpu);
        self.record_forward(gpu, &mut frame, &view);
        let (x, y) = view.tiles();
        frame.dispatch(&kernel, &bindings, x as usize * y as usize);
        frame.submit();
        if self.grow_if_short(gpu)? { Ok(None) } else { gpu.read(&depth, view.pixels()).map(Some) }
    }
}

fn splats_pairs(capacity: usize) -> usize {
    capacity * PAIRS_PER_SPLAT
}

fn layer_buffers(mesh: Option<&MeshStage>) -> Option<LayerBuffers<'_>> {
    mesh.map(|m| LayerBuffers { depth: m.layer_depth(), color: m.layer_color(), gradient: m.layer_gradient() })
}

fn splat_kernel(gpu: &Gpu, splats: &SplatBuffers, Besides { absolute, by_pose }: Besides) -> Kernel {
    let defines = gpu
        .defines()
        .with("SH_TERMS", sh::coefficients(splats.sh_degree) as u32)
        .with("MOMENTS", moments(absolute) as u32)
        .with("ABSOLUTE", u32::from(absolute))
        .with("POSES", u32::from(by_pose));
    Kernel::new(gpu, "splat_backward.wgsl", "main", &defines)
}

fn turn_gradient(gpu: &Gpu, splats: &SplatBuffers, besides: Besides) -> Result<Option<Buffer>, GpuError> {
    besides.by_pose.then(|| gpu.storage("rotation gradients", splats.capacity * 4)).transpose()
}

impl Backward {
    fn new(
        gpu: &Gpu,
        view: &Buffer,
        splats: &SplatBuffers,
        lists: &SplatLists,
        blend: &Blend,
        (image_gradient, status): (Buffer, Buffer),
        besides: Besides,
    ) -> Result<Self, GpuError> {
        let terms = sh::coefficients(splats.sh_degree);
        let unbound = Self {
            capacity: splats.capacity,
            image_gradient,
            geometry_gradient: gpu.storage("geometry gradient", splats.capacity * GEOMETRY)?,
            sh_gradient: gpu.storage("SH gradient", splats.capacity * 3 * terms)?,
            statistics: gpu.storage("density statistics", splats.capacity * 4)?,
            status,
            turn_gradient: turn_gradient(gpu, splats, besides)?,
            besides,
            kernel: splat_kernel(gpu, splats, besides),
            bindings: None,
        };
        Ok(unbound.bind(gpu, view, splats, lists, blend))
    }

    /// The same buffers behind other lists.
    fn bind(mut self, gpu: &Gpu, view: &Buffer, splats: &SplatBuffers, lists: &SplatLists, blend: &Blend) -> Self {
        let mut buffers = vec![
            view,
            &splats.geometry,
            &splats.sh,
            &lists.projected,
            &lists.visible,
            blend.moments().expect("made for training"),
            &self.geometry_gradient,
            &self.sh_gradient,
            &self.statistics,
            &self.status,
        ];
        buffers.extend(&self.turn_gradient);
        self.bindings = Some(self.kernel.bind(gpu, &buffers));
        self
    }
}
