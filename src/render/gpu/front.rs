//! What every picture begins with: a scene's parameters, its mesh layers in a view, and its splats in the lists of tiles.

use super::{
    blend::LayerBuffers,
    device::{Buffer, Frame, Gpu, GpuError},
    mesh::MeshStage,
    splats::{ImageCapacity, Purpose, SplatBuffers, SplatLists, longer_list, longest_list},
    view::{VIEW_WORDS, View},
};
use crate::render::contract::ImageModel;
use crate::scene::{Camera, Composition, HybridScene};

/// (tile, splat) pairs that fit at first, per splat; grown when a frame needs more.
pub(crate) const PAIRS_PER_SPLAT: usize = 6;

/// What one view's frame reads and writes before anything is blended.
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
    /// Of the scene, up to `capacity` splats (at least those it has), seen by `cameras`. What is for training has the `status` of that.
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

    /// Gets ready for a frame of this camera, one of those that it was made for or smaller, and says what the shaders are
    /// told of it, and whether buffers had to be made anew.
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

    /// Appends everything from parameters to layers and lists.
    pub(crate) fn record(&self, gpu: &Gpu, frame: &mut Frame, view: &View) {
        gpu.write(&self.view, 0, &view.words());
        if let Some(mesh) = &self.mesh {
            mesh.record_forward(frame);
        }
        self.lists.record(gpu, frame, view.n_splats as usize);
    }

    /// After a frame: enlarges lists that were too short for it. True if so, and the frame must be repeated.
    ///
    /// # Errors
    /// If the driver failed or the adapter cannot hold longer lists.
    pub(crate) fn grow_if_short(&mut self, gpu: &Gpu) -> Result<bool, GpuError> {
        let needed = self.needed_lengths(gpu)?;
        self.lengthen_lists(gpu, self.longer_lists(gpu, needed))
    }

    /// Entries that lists as of [`Self::list_lengths`] would have held in the last frame. Waits for it.
    ///
    /// # Errors
    /// If the driver failed.
    pub(crate) fn needed_lengths(&self, gpu: &Gpu) -> Result<[usize; 2], GpuError> {
        let (_, pairs) = self.lists.read_counts(gpu)?;
        Ok([pairs, self.mesh.as_ref().map_or(Ok(0), |mesh| mesh.pairs_needed(gpu))?])
    }

    /// How long lists become of which so many entries are needed: 0 where they are long enough.
    pub(crate) fn longer_lists(&self, gpu: &Gpu, needed: [usize; 2]) -> [usize; 2] {
        let lengths = self.list_lengths();
        [0, 1].map(|i| if needed[i] > lengths[i] { longer_list(gpu, needed[i]) } else { 0 })
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

    /// Puts other splat buffers in place of those before, which it returns, and lists with room for at least so many pairs in place of theirs.
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

    /// Frees the lists of (tile, splat) pairs, once nothing is bound to them, so that longer ones need not lie beside them.
    ///
    /// # Errors
    /// If the adapter cannot hold what is there of each splat, which lies beside that of before as yet.
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

/// Lists of these splats; only the EWA model orders them against layers before it blends.
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
