//! Front end of a frame: a scene's parameters, its mesh layers in a view, and its splats in the tiles' lists.

use super::{
    blend::LayerBuffers,
    device::{Buffer, Frame, Gpu, GpuError},
    mesh::MeshStage,
    splats::{ImageCapacity, ListInputs, Purpose, SplatBuffers, SplatLists, longer_list, longest_list},
    view::{VIEW_WORDS, View},
};
use crate::render::contract::ImageModel;
use crate::scene::{Camera, Composition, HybridScene};

/// Initial room for (tile, splat) pairs, per splat; grown when a frame needs more.
pub(crate) const PAIRS_PER_SPLAT: usize = 6;

/// Buffers and stages of a frame before blending.
///
/// Buffers that no longer suffice are replaced. Stages elsewhere that bind them store the [`Self::generation`] at which
/// they did so, and are bound anew before the next frame once it has changed.
pub(crate) struct Front {
    pub(crate) view: Buffer,
    pub(crate) splats: SplatBuffers,
    pub(crate) n_splats: usize,
    pub(crate) mesh: Option<MeshStage>,
    pub(crate) lists: SplatLists,
    pub(crate) composition: Composition,
    pub(crate) image: ImageCapacity,
    /// Number of times that splats or lists were replaced.
    renewals: u64,
    /// [`MeshStage::layer_generation`] that `lists` are bound to; `None` if they are out of date.
    lists_bound_to: Option<u64>,
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
        let pairs = usual_pairs(gpu, capacity, image);
        let layer_depth = layers_to_order_by(mesh.as_ref(), purpose);
        let inputs = ListInputs { purpose, splats: &splats, image, view: &view, layer_depth };
        let lists = SplatLists::new(gpu, &inputs, pairs)?;
        Ok(Self {
            n_splats: scene.splats.len(),
            composition: *composition,
            image,
            renewals: 0,
            lists_bound_to: Some(mesh.as_ref().map_or(0, MeshStage::layer_generation)),
            view,
            splats,
            mesh,
            lists,
        })
    }

    /// Number of times that buffers which others bind were replaced: splats, their lists and mesh layers.
    pub(crate) fn generation(&self) -> u64 {
        // Neither addend ever falls, so the sum changes with either.
        self.renewals + self.layer_generation()
    }

    /// Number of times that the list of (bin, triangle) pairs was replaced, which only the check of lists binds.
    pub(crate) fn triangle_list_generation(&self) -> u64 {
        self.mesh.as_ref().map_or(0, MeshStage::generation)
    }

    /// Prepares a frame of this camera, which must not be larger than those announced. Returns the shaders' view.
    pub(crate) fn prepare(&mut self, gpu: &Gpu, camera: &Camera) -> Result<View, GpuError> {
        let splats = (self.n_splats, self.splats.sh_degree);
        let triangles = self.mesh.as_ref().map_or(0, MeshStage::n_triangles);
        let view = View::of_scene(camera, self.composition, splats, triangles, self.lists.pairs.capacity());
        if let Some(mesh) = &mut self.mesh {
            mesh.resize(gpu, &view, &self.view)?;
        }
        if self.lists_bound_to != Some(self.layer_generation()) {
            self.renew_lists(gpu, self.lists.pairs.capacity())?;
        }
        Ok(view)
    }

    fn layer_generation(&self) -> u64 {
        self.mesh.as_ref().map_or(0, MeshStage::layer_generation)
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
        let longer = self.longer_lists(gpu, self.needed_lengths(gpu)?);
        self.lengthen_lists(gpu, longer)?;
        Ok(longer != [0; 2])
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

    /// Enlarges the lists to at least these lengths.
    ///
    /// # Errors
    /// If the adapter cannot hold them.
    pub(crate) fn lengthen_lists(&mut self, gpu: &Gpu, [splats, triangles]: [usize; 2]) -> Result<(), GpuError> {
        if let Some(mesh) = &mut self.mesh {
            mesh.lengthen(gpu, &self.view, triangles)?;
        }
        if splats > self.lists.pairs.capacity() {
            self.renew_lists(gpu, splats)?;
        }
        Ok(())
    }

    /// Replaces the splat buffers, returning the old ones, and the lists by ones with room for at least `pairs` pairs.
    pub(crate) fn replace_splats(
        &mut self,
        gpu: &Gpu,
        splats: SplatBuffers,
        pairs: usize,
    ) -> Result<SplatBuffers, GpuError> {
        let before = std::mem::replace(&mut self.splats, splats);
        let usual = usual_pairs(gpu, self.splats.capacity, self.image);
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
        self.renewals += 1;
        // Should this fail, the old lists are out of date: `splats` may have been replaced.
        self.lists_bound_to = None;
        let purpose = self.lists.purpose();
        let layer_depth = layers_to_order_by(self.mesh.as_ref(), purpose);
        let inputs = ListInputs { purpose, splats: &self.splats, image: self.image, view: &self.view, layer_depth };
        self.lists = SplatLists::new(gpu, &inputs, pairs)?;
        self.lists_bound_to = Some(self.layer_generation());
        Ok(())
    }

    /// Buffers of the mesh layers, if there are meshes.
    pub(crate) fn layers(&self) -> Option<LayerBuffers<'_>> {
        let m = self.mesh.as_ref()?;
        Some(LayerBuffers { depth: m.layer_depth(), color: m.layer_color(), gradient: m.layer_gradient() })
    }
}

/// Room for (tile, splat) pairs that lists have before a frame needs more.
fn usual_pairs(gpu: &Gpu, splats: usize, image: ImageCapacity) -> usize {
    (splats * PAIRS_PER_SPLAT + image.tiles).min(longest_list(gpu))
}

/// [`ListInputs::layer_depth`]: only under the EWA model are splats ordered against layers before blending.
fn layers_to_order_by(mesh: Option<&MeshStage>, purpose: Purpose) -> Option<(&Buffer, u32)> {
    let is_ordered = !matches!(purpose, Purpose::Render(ImageModel::Ray(_)));
    mesh.filter(|_| is_ordered).map(|m| (m.layer_depth(), m.layers()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::contract::ShDirection;
    use crate::render::gpu::geometry::{GEOMETRY_FLOATS, OPACITY};
    use crate::render::testing::smooth_scene;
    use crate::scene::OrderMode;

    /// Whatever a compiler makes of comparisons with them.
    #[test]
    fn splats_that_are_not_numbers_are_in_no_list() {
        let gpu = Gpu::open(None).unwrap();
        let (scene, camera) = smooth_scene(1, 2, OrderMode::Stable);
        assert_eq!(scene.splats.len(), 5);
        for model in [ImageModel::Ewa, ImageModel::Ray(ShDirection::Mean)] {
            let mut front = Front::new(&gpu, &scene, 0, &[camera], Purpose::Render(model), None).unwrap();
            let view = front.prepare(&gpu, &camera).unwrap();
            let listed = || {
                let mut frame = Frame::new(&gpu);
                front.record(&gpu, &mut frame, &view);
                frame.submit();
                (gpu.read::<u32>(&front.lists.visible, 5).unwrap(), front.lists.read_counts(&gpu).unwrap().0)
            };
            assert_eq!(listed(), (vec![1; 5], 5), "{model:?}");
            // A part of a mean, of a quaternion, of a scale, and an opacity.
            for (splat, column) in [0, 6, 9, OPACITY].into_iter().enumerate() {
                gpu.write(&front.splats.geometry, 4 * (splat * GEOMETRY_FLOATS + column) as u64, &[f32::NAN]);
            }
            assert_eq!(listed(), (vec![0, 0, 0, 0, 1], 1), "{model:?}");
        }
    }

    #[test]
    fn every_replacement_makes_another_generation() {
        let gpu = Gpu::open(None).unwrap();
        let (scene, camera) = smooth_scene(1, 2, OrderMode::Stable);
        let mut front = Front::new(&gpu, &scene, 0, &[camera], Purpose::Render(ImageModel::Ewa), None).unwrap();
        let [pairs, triangles] = front.list_lengths();
        let mut renews = |change: &dyn Fn(&mut Front) -> Result<(), GpuError>| {
            let before = [front.generation(), front.triangle_list_generation()];
            change(&mut front).unwrap();
            assert_eq!(front.lists_bound_to, Some(front.layer_generation()), "lists are never left behind");
            [front.generation() > before[0], front.triangle_list_generation() > before[1]]
        };
        let k = camera.intrinsics();
        let larger = camera.resized(2 * k.width, 2 * k.height);
        let sh_degree = scene.splats.sh_degree();
        assert_eq!(renews(&|f| f.prepare(&gpu, &camera).map(drop)), [false; 2]);
        assert_eq!(renews(&|f| f.lengthen_lists(&gpu, [pairs, triangles])), [false; 2]);
        assert_eq!(renews(&|f| f.lengthen_lists(&gpu, [pairs + 1, 0])), [true, false]);
        assert_eq!(renews(&|f| f.lengthen_lists(&gpu, [0, triangles + 1])), [false, true]);
        assert_eq!(renews(&|f| f.empty_lists(&gpu)), [true, false]);
        let splats = || SplatBuffers::new(&gpu, 9, sh_degree);
        assert_eq!(renews(&|f| f.replace_splats(&gpu, splats()?, 0).map(drop)), [true, false]);
        assert_eq!(renews(&|f| f.prepare(&gpu, &larger).map(drop)), [true; 2], "layers of more pixels");
        assert_eq!(front.list_lengths()[0], 9 * PAIRS_PER_SPLAT + front.image.tiles, "as in new buffers");
    }
}
