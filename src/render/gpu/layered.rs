//! Pictures in parts, under either image model: contributions of splats and of meshes, depths, normals. One thread per
//! pixel, for pictures that are kept; training and viewing use [`super::Renderer`].

use super::{
    device::{Buffer, Frame, Gpu, GpuError, Stage},
    front::Front,
    mesh::MeshStage,
    picture::Picture,
    splats::{ImageCapacity, Purpose},
    unit::Unit,
};
use crate::render::contract::{ImageModel, ShDirection};
use crate::scene::{Camera, HybridScene, sh};

/// Four-float vectors that the shaders write per pixel.
const PARTS: usize = 4;
/// Upper bound on a pixel's passes through loops other than the walk through its tile's list.
const OTHER_PASSES: usize = 100;
/// Words of the progress buffer before the first pixel, and per pixel.
const PROGRESS: usize = 4;

/// The parts of a picture in the scene's blending space, row-major from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct LayeredPicture {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Contribution of splats, as occluded by meshes: RGB times weight, and the sum of weights. `[height·width]`
    pub splats: Vec<[f32; 4]>,
    /// Contribution of meshes, as occluded by splats, likewise.
    pub mesh: Vec<[f32; 4]>,
    /// Weight of the background: 1 − both weights.
    pub transmittance: Vec<f32>,
    /// Expected depth, camera-space z: mean of the contributions' depths by weight; 0 if there is none. A splat's depth
    /// is that of its mean, or of its peak under [`ImageModel::Ray`].
    pub expected_depth: Vec<f32>,
    /// Camera-space z at which the transmittance falls below one half; 0 where it never does.
    pub median_depth: Vec<f32>,
    /// Number of splats that contribute.
    pub count: Vec<f32>,
    /// Unit normal of the nearest mesh fragment, facing the camera, in world space; zero without one.
    pub normal: Vec<[f32; 3]>,
}

impl LayeredPicture {
    /// The picture over a background.
    #[must_use]
    pub fn over(&self, background: [f32; 3]) -> Vec<[f32; 3]> {
        let parts = self.splats.iter().zip(&self.mesh).zip(&self.transmittance);
        parts.map(|((s, m), t)| [0, 1, 2].map(|c| s[c] + m[c] + t * background[c])).collect()
    }

    /// The picture over a background, as [`super::Renderer`] returns it.
    #[must_use]
    pub fn flattened(self, background: [f32; 3]) -> Picture {
        let rgb = self.over(background);
        Picture { width: self.width, height: self.height, rgb, transmittance: self.transmittance }
    }
}

/// Renderer of a scene's pictures in parts.
///
/// Needs the memory of [`super::Renderer`] and 48 bytes more per pixel (64 on Mesa's software adapter); under
/// [`ImageModel::Ray`] 80 more per splat, and 4 less per splat and mesh layer.
pub struct LayeredRenderer<'g> {
    gpu: &'g Gpu,
    model: ImageModel,
    unit: Unit,
    front: Front,
    parts: Buffer,
    /// Progress of each pixel, where one dispatch may not finish them (`shaders/shared/layered.wgsl`).
    progress: Option<Buffer>,
    blend: Stage,
    /// [`Front::generation`] that `blend` is bound to.
    bound_to: u64,
}

impl<'g> LayeredRenderer<'g> {
    /// Uploads the scene and makes room for pictures up to the sizes of `cameras`. As by [`super::Renderer::new`], very
    /// small and very large scenes are rendered in another unit of length; depths are in that of the world.
    ///
    /// # Errors
    /// If the composition is not valid, or the adapter cannot hold the scene.
    pub fn new(gpu: &'g Gpu, scene: &HybridScene, cameras: &[Camera], model: ImageModel) -> Result<Self, GpuError> {
        scene.composition.validate().map_err(GpuError::Scene)?;
        let unit = Unit::of(scene, cameras);
        let scene = unit.scene(scene).map_err(GpuError::Scene)?;
        let front = Front::new(gpu, &scene, 0, cameras, Purpose::Render(model), None)?;
        let parts = gpu.storage("parts of the picture", front.image.pixels * PARTS * 4)?;
        let words = PROGRESS * (1 + front.image.pixels);
        let progress = gpu.loop_passes().map(|_| gpu.storage("progress of the picture", words)).transpose()?;
        let blend = blend(gpu, model, &front, &parts, progress.as_ref());
        let bound_to = front.generation();
        Ok(Self { gpu, model, unit, front, parts, progress, blend, bound_to })
    }

    /// Renders one picture and waits for it.
    ///
    /// # Errors
    /// If the image is larger than announced, the driver fails, the adapter runs short of memory or, on Mesa's software
    /// adapter, a tile has more splats than it can process.
    pub fn render(&mut self, camera: &Camera) -> Result<LayeredPicture, GpuError> {
        self.front.image.check(camera)?;
        loop {
            self.submit(camera)?;
            if !self.front.grow_if_short(self.gpu)? {
                break;
            }
        }
        self.finish(camera)?;
        self.read(camera)
    }

    /// Repeats the blend until all pixels are finished.
    fn finish(&self, camera: &Camera) -> Result<(), GpuError> {
        let (Some(progress), Some(passes)) = (&self.progress, self.gpu.loop_passes()) else { return Ok(()) };
        let tiles = ImageCapacity::of([(camera.intrinsics().width, camera.intrinsics().height)]).tiles;
        // The last walk to begin has the passes that those before it leave; other loops of a pixel, over slots and
        // layers, take some tens.
        let (splats, most) = (self.front.lists.longest(self.gpu, tiles)?, passes - patience(passes) - OTHER_PASSES);
        if splats > most {
            return Err(GpuError::TileTooFull { splats, most, adapter: self.gpu.adapter().to_owned() });
        }
        while self.gpu.read::<u32>(progress, 1)?[0] != 0 {
            self.gpu.write(progress, 0, &[0_u32]);
            let mut frame = Frame::new(self.gpu);
            frame.dispatch(&self.blend, tiles);
            frame.submit();
        }
        Ok(())
    }

    fn submit(&mut self, camera: &Camera) -> Result<(), GpuError> {
        let view = self.front.prepare(self.gpu, &self.unit.camera(camera))?;
        self.refresh();
        let mut frame = Frame::new(self.gpu);
        self.progress.iter().for_each(|progress| frame.clear(progress));
        self.front.record(self.gpu, &mut frame, &view);
        frame.split();
        frame.dispatch(&self.blend, view.n_tiles());
        frame.submit();
        Ok(())
    }

    /// Binds the blend to the present buffers, if any was replaced.
    fn refresh(&mut self) {
        let generation = self.front.generation();
        if self.bound_to != generation {
            self.blend = blend(self.gpu, self.model, &self.front, &self.parts, self.progress.as_ref());
            self.bound_to = generation;
        }
    }

    fn read(&self, camera: &Camera) -> Result<LayeredPicture, GpuError> {
        let k = camera.intrinsics();
        let words: Vec<[[f32; 4]; PARTS]> = self.gpu.read(&self.parts, k.pixels())?;
        Ok(LayeredPicture {
            width: k.width,
            height: k.height,
            splats: words.iter().map(|p| p[0]).collect(),
            mesh: words.iter().map(|p| p[1]).collect(),
            expected_depth: self.unit.in_world(words.iter().map(|p| p[2][0]).collect()),
            median_depth: self.unit.in_world(words.iter().map(|p| p[2][1]).collect()),
            count: words.iter().map(|p| p[2][2]).collect(),
            transmittance: words.iter().map(|p| p[2][3]).collect(),
            normal: words.iter().map(|p| [p[3][0], p[3][1], p[3][2]]).collect(),
        })
    }
}

/// Number of entries of a tile's list after which a thread begins no further walk through it, so that one more fits.
fn patience(loop_passes: usize) -> usize {
    loop_passes / 4
}

fn blend(gpu: &Gpu, model: ImageModel, front: &Front, parts: &Buffer, progress: Option<&Buffer>) -> Stage {
    let Front { view, splats, mesh, lists, .. } = front;
    let by_ray = model == ImageModel::Ray(ShDirection::Ray);
    let defines = gpu
        .defines()
        .with("LAYERS", mesh.as_ref().map_or(0, MeshStage::layers))
        .with("SH_TERMS", sh::coefficients(splats.sh_degree) as u32)
        .with("SH_BY_RAY", u32::from(by_ray))
        .with("PATIENCE", gpu.loop_passes().map_or(0, |passes| patience(passes) as u32))
        .with("PARTS", PARTS as u32);
    let mut buffers = vec![view, &lists.pairs.ranges, lists.pairs.splats(), &lists.projected, parts];
    if let Some(m) = mesh {
        buffers.extend([m.layer_depth(), m.layer_color(), m.layer_triangle(), m.corners()]);
    }
    let file = match &lists.rays {
        None => {
            if mesh.is_some() {
                buffers.push(&lists.thresholds);
            }
            "blend_layers.wgsl"
        }
        Some(rays) => {
            buffers.push(rays);
            if by_ray {
                buffers.push(&splats.sh);
            }
            "blend_rays.wgsl"
        }
    };
    buffers.extend(progress);
    Stage::new(gpu, file, "main", &defines, &buffers)
}
