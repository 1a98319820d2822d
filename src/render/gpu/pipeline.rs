//! One frame from parameters to the image: which stage runs when, on which buffers. `backward` is the way back.

use super::{
    blend::{Blend, LayerBuffers},
    device::{Buffer, Frame, Gpu, GpuError, Stage},
    mesh::MeshStage,
    picture::Picture,
    splats::{ImageCapacity, Purpose, SplatBuffers, SplatLists, longer_list, longest_list},
    view::{VIEW_WORDS, View},
};
use crate::render::contract::ImageModel;
use crate::scene::{Camera, Composition, HybridScene, Mesh};

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
    pub(crate) image: ImageCapacity,
}

impl Pipeline {
    /// A pipeline for the scene, up to `capacity` splats (at least those it has), seen by `cameras`. With the `status` of a
    /// training it is one that can be differentiated.
    pub(crate) fn new(
        gpu: &Gpu,
        scene: &HybridScene,
        capacity: usize,
        cameras: &[Camera],
        status: Option<&Buffer>,
    ) -> Result<Self, GpuError> {
        let capacity = capacity.max(scene.splats.len());
        let splats = SplatBuffers::new(gpu, capacity, scene.splats.sh_degree())?;
        splats.write(gpu, &scene.splats);
        let mut built =
            Self::assemble(gpu, splats, &scene.meshes, scene.composition, cameras, splats_pairs(capacity), status)?;
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
        status: Option<&Buffer>,
    ) -> Result<Self, GpuError> {
        let image = ImageCapacity::of(cameras.iter().map(|c| (c.intrinsics().width, c.intrinsics().height)));
        let view = gpu.uniform("view", VIEW_WORDS)?;
        let mut mesh = match meshes {
            [] => None,
            _ => Some(MeshStage::new(gpu, meshes, composition.layers, status)?),
        };
        if let Some(mesh) = &mut mesh {
            for camera in cameras {
                let size = View::of(camera, composition);
                mesh.resize(gpu, &size, &view)?;
            }
        }
        let depth = mesh.as_ref().map(|m| (m.layer_depth(), composition.layers));
        let purpose = if status.is_some() { Purpose::Train } else { Purpose::Render(ImageModel::Ewa) };
        let pairs = (pairs + image.tiles).min(longest_list(gpu));
        let lists = SplatLists::new(gpu, purpose, &splats, image, pairs, &view, depth)?;
        let blend = Blend::new(gpu, &lists, image, &view, layer_buffers(mesh.as_ref()))?;
        Ok(Self { view, n_splats: 0, splats, mesh, lists, blend, composition, image })
    }

    /// Gets ready for a frame of this camera, one of those that the pipeline was made for or smaller, and says what
    /// the shaders are told of it, and whether buffers had to be made anew.
    pub(crate) fn prepare(&mut self, gpu: &Gpu, camera: &Camera) -> Result<(View, bool), GpuError> {
        let splats = (self.n_splats, self.splats.sh_degree);
        let triangles = self.mesh.as_ref().map_or(0, MeshStage::n_triangles);
        let view = View::of_scene(camera, self.composition, splats, triangles, self.lists.pairs.capacity());
        let grew = match &mut self.mesh {
            Some(mesh) => mesh.resize(gpu, &view, &self.view)?,
            None => false,
        };
        if grew {
            self.renew_lists(gpu, self.lists.pairs.capacity())?;
        }
        Ok((view, grew))
    }

    /// Appends everything from parameters to the image.
    pub(crate) fn record(&self, gpu: &Gpu, frame: &mut Frame, view: &View) {
        gpu.write(&self.view, 0, &view.words());
        if let Some(mesh) = &self.mesh {
            mesh.record_forward(frame);
        }
        self.lists.record(gpu, frame, view.n_splats as usize);
        self.blend.record(frame, view.n_tiles());
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
        let short = pairs > self.lists.pairs.capacity();
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
        [self.lists.pairs.capacity(), self.mesh.as_ref().map_or(0, MeshStage::pair_capacity)]
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
        let short = splats > self.lists.pairs.capacity();
        if short {
            self.renew_lists(gpu, splats)?;
        }
        Ok(short || mesh_grew)
    }

    /// Makes the pipeline anew around other splat buffers (for more splats); returns those before.
    pub(crate) fn replace_splats(&mut self, gpu: &Gpu, splats: SplatBuffers) -> Result<SplatBuffers, GpuError> {
        let before = std::mem::replace(&mut self.splats, splats);
        let pairs = splats_pairs(self.splats.capacity).min(longest_list(gpu));
        self.renew_lists(gpu, pairs.max(self.lists.pairs.capacity()))?;
        Ok(before)
    }

    fn renew_lists(&mut self, gpu: &Gpu, pairs: usize) -> Result<(), GpuError> {
        let depth = self.mesh.as_ref().map(|m| (m.layer_depth(), self.composition.layers));
        let purpose = self.lists.purpose();
        self.lists = SplatLists::new(gpu, purpose, &self.splats, self.image, pairs, &self.view, depth)?;
        self.blend.rebind(gpu, &self.lists, &self.view, layer_buffers(self.mesh.as_ref()));
        Ok(())
    }

    /// Buffers of the mesh layers, if there are meshes.
    pub(crate) fn layers(&self) -> Option<LayerBuffers<'_>> {
        layer_buffers(self.mesh.as_ref())
    }

    /// The image of the last frame, which was of `camera`. Waits.
    pub(crate) fn read_picture(&self, gpu: &Gpu, camera: &Camera) -> Result<Picture, GpuError> {
        let k = camera.intrinsics();
        let words: Vec<[f32; 4]> = gpu.read(&self.blend.image, k.pixels())?;
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
        let (view, renewed) = self.prepare(gpu, camera)?;
        if renewed {
            return Ok(None);
        }
        let depth = gpu.storage("median depth", view.pixels())?;
        let lists = &self.lists;
        let buffers =
            [&self.view, &lists.pairs.ranges, lists.pairs.splats(), &lists.projected, &depth, &self.splats.geometry];
        let blend = Stage::new(gpu, "blend_depth.wgsl", "main", &gpu.defines(), &buffers);
        let mut frame = Frame::new(gpu);
        self.record(gpu, &mut frame, &view);
        frame.dispatch(&blend, view.n_tiles());
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
