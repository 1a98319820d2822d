//! Pictures in parts, under either image model: what splats and meshes contribute, depths, normals. One thread a pixel,
//! for pictures that are kept; training and viewing take [`super::Renderer`].

use super::{
    device::{Buffer, Frame, Gpu, GpuError, Stage},
    mesh::MeshStage,
    picture::Picture,
    pipeline::PAIRS_PER_SPLAT,
    splats::{ImageCapacity, Purpose, SplatBuffers, SplatLists, longer_list},
    view::{VIEW_WORDS, View},
};
use crate::render::contract::{ImageModel, ShDirection};
use crate::scene::{Camera, Composition, HybridScene, sh};

/// Vectors of four floats that the shaders write per pixel.
const PARTS: usize = 4;

/// The parts of a picture in the scene's blending space, row-major from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct LayeredPicture {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// What splats contribute where meshes hide them: RGB times weight, and the sum of weights. `[height·width]`
    pub splats: Vec<[f32; 4]>,
    /// What meshes contribute where splats hide them, likewise.
    pub mesh: Vec<[f32; 4]>,
    /// What is left of the background: 1 − both weights.
    pub transmittance: Vec<f32>,
    /// Camera-space z: mean of what contributes by its weight; 0 where nothing does. Of a splat it is that of its mean, or
    /// of its peak under [`ImageModel::Ray`].
    pub expected_depth: Vec<f32>,
    /// Camera-space z at which the transmittance falls below one half; 0 where it never does.
    pub median_depth: Vec<f32>,
    /// Splats that contribute.
    pub count: Vec<f32>,
    /// Unit normal of the nearest mesh fragment, towards the camera, in world space; zeros without one.
    pub normal: Vec<[f32; 3]>,
}

impl LayeredPicture {
    /// The picture over a background.
    #[must_use]
    pub fn over(&self, background: [f32; 3]) -> Vec<[f32; 3]> {
        let parts = self.splats.iter().zip(&self.mesh).zip(&self.transmittance);
        parts.map(|((s, m), t)| [0, 1, 2].map(|c| s[c] + m[c] + t * background[c])).collect()
    }

    /// The same as a renderer of whole pictures gives it.
    #[must_use]
    pub fn flattened(self, background: [f32; 3]) -> Picture {
        let rgb = self.over(background);
        Picture { width: self.width, height: self.height, rgb, transmittance: self.transmittance }
    }
}

/// A scene on the GPU, ready to be taken apart.
///
/// Takes what [`super::Renderer`] takes, and 48 bytes more per pixel; under [`ImageModel::Ray`] 80 more per splat, and 4 less per
/// splat and mesh layer.
pub struct LayeredRenderer<'g> {
    gpu: &'g Gpu,
    model: ImageModel,
    composition: Composition,
    n_splats: usize,
    view: Buffer,
    splats: SplatBuffers,
    mesh: Option<MeshStage>,
    image: ImageCapacity,
    lists: SplatLists,
    parts: Buffer,
    blend: Stage,
}

impl<'g> LayeredRenderer<'g> {
    /// Uploads the scene and makes room for pictures up to the sizes of `cameras`.
    ///
    /// # Errors
    /// If the composition is not valid, or the adapter cannot hold the scene.
    pub fn new(gpu: &'g Gpu, scene: &HybridScene, cameras: &[Camera], model: ImageModel) -> Result<Self, GpuError> {
        scene.composition.validate()?;
        let composition = scene.composition;
        let splats = SplatBuffers::new(gpu, scene.splats.len(), scene.splats.sh_degree())?;
        splats.write(gpu, &scene.splats);
        let view = gpu.uniform("view", VIEW_WORDS)?;
        let mut mesh = match scene.meshes.as_slice() {
            [] => None,
            meshes => Some(MeshStage::new(gpu, meshes, composition.layers, None)?),
        };
        if let Some(mesh) = &mut mesh {
            for camera in cameras {
                mesh.resize(gpu, &View::of(camera, composition), &view)?;
            }
        }
        let image = ImageCapacity::of(cameras.iter().map(|c| (c.intrinsics().width, c.intrinsics().height)));
        let parts = gpu.storage("parts of the picture", image.pixels * PARTS * 4)?;
        let pairs = splats.capacity * PAIRS_PER_SPLAT + image.tiles;
        let lists = lists(gpu, model, &splats, image, pairs, &view, mesh.as_ref())?;
        let blend = blend(gpu, model, &view, &splats, mesh.as_ref(), &lists, &parts);
        let n_splats = scene.splats.len();
        Ok(Self { gpu, model, composition, n_splats, view, splats, mesh, image, lists, parts, blend })
    }

    /// Renders one picture and waits for it.
    ///
    /// # Errors
    /// If the image is larger than announced, the driver fails or the adapter runs short of memory.
    pub fn render(&mut self, camera: &Camera) -> Result<LayeredPicture, GpuError> {
        self.image.check(camera)?;
        loop {
            self.submit(camera)?;
            let (_, pairs) = self.lists.read_counts(self.gpu)?;
            let mesh_grew = match &mut self.mesh {
                Some(mesh) => mesh.grow_if_short(self.gpu, &self.view)?,
                None => false,
            };
            if pairs > self.lists.pairs.capacity() {
                self.renew(longer_list(self.gpu, pairs))?;
            } else if !mesh_grew {
                break;
            }
        }
        self.read(camera)
    }

    fn submit(&mut self, camera: &Camera) -> Result<(), GpuError> {
        let splats = (self.n_splats, self.splats.sh_degree);
        let triangles = self.mesh.as_ref().map_or(0, MeshStage::n_triangles);
        let view = View::of_scene(camera, self.composition, splats, triangles, self.lists.pairs.capacity());
        if let Some(mesh) = &mut self.mesh
            && mesh.resize(self.gpu, &view, &self.view)?
        {
            self.renew(self.lists.pairs.capacity())?;
        }
        self.gpu.write(&self.view, 0, &view.words());
        let mut frame = Frame::new(self.gpu);
        if let Some(mesh) = &self.mesh {
            mesh.record_forward(&mut frame);
        }
        self.lists.record(self.gpu, &mut frame, self.n_splats);
        frame.dispatch(&self.blend, view.n_tiles());
        frame.submit();
        Ok(())
    }

    fn renew(&mut self, pairs: usize) -> Result<(), GpuError> {
        let (gpu, mesh) = (self.gpu, self.mesh.as_ref());
        self.lists = lists(gpu, self.model, &self.splats, self.image, pairs, &self.view, mesh)?;
        self.blend = blend(gpu, self.model, &self.view, &self.splats, mesh, &self.lists, &self.parts);
        Ok(())
    }

    fn read(&self, camera: &Camera) -> Result<LayeredPicture, GpuError> {
        let k = camera.intrinsics();
        let words: Vec<[[f32; 4]; PARTS]> = self.gpu.read(&self.parts, k.pixels())?;
        Ok(LayeredPicture {
            width: k.width,
            height: k.height,
            splats: words.iter().map(|p| p[0]).collect(),
            mesh: words.iter().map(|p| p[1]).collect(),
            expected_depth: words.iter().map(|p| p[2][0]).collect(),
            median_depth: words.iter().map(|p| p[2][1]).collect(),
            count: words.iter().map(|p| p[2][2]).collect(),
            transmittance: words.iter().map(|p| p[2][3]).collect(),
            normal: words.iter().map(|p| [p[3][0], p[3][1], p[3][2]]).collect(),
        })
    }
}

/// Tile lists; only the EWA model orders splats against layers before it blends.
fn lists(
    gpu: &Gpu,
    model: ImageModel,
    splats: &SplatBuffers,
    image: ImageCapacity,
    pairs: usize,
    view: &Buffer,
    mesh: Option<&MeshStage>,
) -> Result<SplatLists, GpuError> {
    let depth = mesh.filter(|_| model == ImageModel::Ewa).map(|m| (m.layer_depth(), m.layers()));
    SplatLists::new(gpu, Purpose::Render(model), splats, image, pairs, view, depth)
}

fn blend(
    gpu: &Gpu,
    model: ImageModel,
    view: &Buffer,
    splats: &SplatBuffers,
    mesh: Option<&MeshStage>,
    lists: &SplatLists,
    parts: &Buffer,
) -> Stage {
    let by_ray = model == ImageModel::Ray(ShDirection::Ray);
    let defines = gpu
        .defines()
        .with("LAYERS", mesh.map_or(0, MeshStage::layers))
        .with("SH_TERMS", sh::coefficients(splats.sh_degree) as u32)
        .with("SH_BY_RAY", u32::from(by_ray))
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
    Stage::new(gpu, file, "main", &defines, &buffers)
}
