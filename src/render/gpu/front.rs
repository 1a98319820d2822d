//! Front end of a frame: a scene's parameters, its mesh layers in a view, and its splats in the tiles' lists.

use super::{
    blend::LayerBuffers,
    device::{Buffer, Frame, Gpu, GpuError},
    mesh::MeshStage,
    splats::{ImageCapacity, Purpose, SplatBuffers, SplatLists, longer_list, longest_list},
    view::{VIEW_WORDS, View},
};
use crate::render::contract::ImageModel;
use crate::scene::{Camera, Composition, HybridScene};

/// Initial room for (tile, splat) pairs, per splat; grown when a frame needs more.
pub(crate) const PAIRS_PER_SPLAT: usize = 6;

/// Buffers and stages of a frame before blending.
pub(crate) struct Front {
    pub(crate) view: Buffer,
    pub(crate) splats: SplatBuffers,
    pub(crate) n_splats: usize,
    pub(crate) mesh: Option<MeshStage>,
    pub(crate) lists: SplatLists,
    pub(crate) composition: Composition,
    pub(crate) image: ImageCapacity,
}

impl Front {
    /// Front end for the scene, with room for `capacity` splats (at least those it has), seen by `cameras`. For
    /// training, `status` is that of its steps.
    pub(crate) fn new(
        gpu: &Gpu,
        scene: &HybridScene,
        capacity: usize,
        cameras: &[Camera],
        purpose: Purpose,
        status: Option<&Buffer>,
    ) -> Result<Self, GpuError> {
        let HybridScene { meshes, composition, .. } = scene;
        let capacity = capacity.max(scene.splats.len());
        let splats = SplatBuffers::new(gpu, capacity, scene.splats.sh_degree())?;
        splats.write(gpu, &scene.splats);
        let image = ImageCapacity::of(cameras.iter().map(|c| (c.intrinsics().width, c.intrinsics().height)));
        let view = gpu.uniform("view", VIEW_WORDS)?;
        let mut mesh = match meshes.as_slice() {
            [] => None,
            meshes => Some(MeshStage::new(gpu, meshes, composition.layers, status)?),
        };
        if let Some(mesh) = &mut mesh {
            mesh.make_room(gpu, cameras, &view)?;
        }
        let pairs = (capacity * PAIRS_PER_SPLAT + image.tiles).min(longest_list(gpu));
        let lists = lists(gpu, purpose, &splats, image, pairs, &view, mesh.as_ref())?;
        Ok(Self { view, splats, n_splats: scene.splats.len(), mesh, lists, composition: *composition, image })
    }

    /// Prepares a frame of this camera, which must not be larger than those announced. Returns the shaders' view, and
    /// whether buffers were replaced.
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

    /// Appends all stages from parameters to layers and lists.
    pub(crate) fn record(&self, gpu: &Gpu, frame: &mut Frame, view: &View) {
        gpu.write(&self.view, 0, &view.words());
        if let Some(mesh) = &self.mesh {
            mesh.record_forward(frame);
        }
        self.lists.record(gpu, frame, view.n_splats as usize);
    }

    /// After a frame: enlarges lists that were too short for it. True if so; the frame must then be repeated.
    ///
    /// # Errors
    /// If the driver failed or the adapter cannot hold longer lists.
    pub(crate) fn grow_if_short(&mut self, gpu: &Gpu) -> Result<bool, GpuError> {
        let needed = self.needed_lengths(gpu)?;
        self.lengthen_lists(gpu, self.longer_lists(gpu, needed))
    }

    /// Entries that the lists of [`Self::list_lengths`] needed in the last frame. Waits for it.
    ///
    /// # Errors
    /// If the driver failed.
    pub(crate) fn needed_lengths(&self, gpu: &Gpu) -> Result<[usize; 2], GpuError> {
        let (_, pairs) = self.lists.read_counts(gpu)?;
        Ok([pairs, self.mesh.as_ref().map_or(Ok(0), |mesh| mesh.pairs_needed(gpu))?])
    }

    /// New lengths of lists that need this many entries: 0 where they are long enough.
    pub(crate) fn longer_lists(&self, gpu: &Gpu, needed: [usize; 2]) -> [usize; 2] {
        let lengths = self.list_lengths();
        [0, 1].map(|i| if needed[i] > lengths[i] { longer_list(gpu, needed[i]) } else { 0 })
    }

    /// Capacities of the lists of (tile, splat) and (bin, triangle) pairs.
    pub(crate) fn list_lengths(&self) -> [usize; 2] {
        [self.lists.pairs.capacity(), self.mesh.as_ref().map_or(0, MeshStage::pair_capacity)]
    }

    /// Enlarges the lists to at least these lengths. True if any was replaced.
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

    /// Replaces the splat buffers, returning the old ones, and the lists by ones with room for at least `pairs` pairs.
    pub(crate) fn replace_splats(
        &mut self,
        gpu: &Gpu,
        splats: SplatBuffers,
        pairs: usize,
    ) -> Result<SplatBuffers, GpuError> {
        let before = std::mem::replace(&mut self.splats, splats);
        let usual = (self.splats.capacity * PAIRS_PER_SPLAT).min(longest_list(gpu));
        self.renew_lists(gpu, usual.max(pairs))?;
        Ok(before)
    }

    /// Frees the lists of (tile, splat) pairs, which must not be bound any more, so that old and longer new ones need
    /// not coexist.
    ///
    /// # Errors
    /// If the adapter cannot hold the new per-splat buffers beside the old ones.
    pub(crate) fn empty_lists(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        self.renew_lists(gpu, 0)
    }

    fn renew_lists(&mut self, gpu: &Gpu, pairs: usize) -> Result<(), GpuError> {
        let purpose = self.lists.purpose();
        self.lists = lists(gpu, purpose, &self.splats, self.image, pairs, &self.view, self.mesh.as_ref())?;
        Ok(())
    }

    /// Buffers of the mesh layers, if there are meshes.
    pub(crate) fn layers(&self) -> Option<LayerBuffers<'_>> {
        let m = self.mesh.as_ref()?;
        Some(LayerBuffers { depth: m.layer_depth(), color: m.layer_color(), gradient: m.layer_gradient() })
    }
}

/// Lists of these splats; only under the EWA model are they ordered against layers before blending.
fn lists(
    gpu: &Gpu,
    purpose: Purpose,
    splats: &SplatBuffers,
    image: ImageCapacity,
    pairs: usize,
    view: &Buffer,
    mesh: Option<&MeshStage>,
) -> Result<SplatLists, GpuError> {
    let is_ordered = !matches!(purpose, Purpose::Render(ImageModel::Ray(_)));
    let depth = mesh.filter(|_| is_ordered).map(|m| (m.layer_depth(), m.layers()));
    SplatLists::new(gpu, purpose, splats, image, pairs, view, depth)
}
