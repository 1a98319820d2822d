//! The maps of all meshes on the adapter: parameters, gradients, Adam moments.
//!
//! Zeroth coefficients and opacities of all meshes share one buffer, higher bands another, so that no kernel binds
//! more than it needs and each buffer has the whole binding limit. In a buffer of texels or gradients every map is a
//! mip pyramid (level 0, then level 1, …); moments exist for level 0 only. Bytes per level-0 float: 5⅓ to render,
//! and 13⅓ more to train.

use super::adam::{self, bias_corrections};
use super::device::{Buffer, Frame, Gpu, GpuError, Kernel, Stage};
use super::shader::Defines;
#[cfg(test)]
use super::shader::{BAND_UNIT, CROWD, FIXED_ONE};
use crate::scene::{Atlas, Mesh, SceneError, Texture, sh};

/// Base `[h·w·4]` and bands of one mesh's gradient.
#[cfg(test)]
pub(crate) type AtlasGradient = (Vec<f32>, Vec<f32>);

/// Words of [`Texels::peaks`], see there.
pub(crate) const PEAKS: usize = 4;
/// Fragments per thread of `gradient_peak.wgsl`.
pub(crate) const PEAK_FRAGMENTS: usize = 16;

/// Kernel that sets word `peak` of [`Texels::peaks`]; word 0, for the maps, comes with the last two. `defines` are
/// those of the mesh stage.
pub(crate) fn peak_kernel(gpu: &Gpu, defines: &Defines, peak: u32) -> Kernel {
    let of_maps = u32::from(peak == 0);
    let defines = (defines.clone().with("PEAK", peak).with("MAPS", of_maps)).with("FRAGMENTS", PEAK_FRAGMENTS as u32);
    Kernel::new(gpu, "gradient_peak.wgsl", "peak", &defines)
}

/// What a step of Adam needs besides the gradients.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct TexelStep {
    /// Number of this step, from 1.
    pub(crate) number: u32,
    /// Rate of zeroth coefficients and opacity logits.
    pub(crate) base_rate: f32,
    /// Rate of higher bands.
    pub(crate) band_rate: f32,
    /// Skip floats whose gradient is exactly 0, moments included: texels that no pixel saw do not drift.
    pub(crate) visited_only: bool,
    /// Freeze opacity logits and their moments, while colours are learnt.
    pub(crate) holds_opacity: bool,
}

impl TexelStep {
    fn words(&self) -> [u32; 6] {
        let [first, second] = bias_corrections(self.number).map(f32::to_bits);
        [
            self.base_rate.to_bits(),
            self.band_rate.to_bits(),
            first,
            second,
            u32::from(self.visited_only),
            u32::from(self.holds_opacity),
        ]
    }
}

/// Layout of one texture in its buffers.
#[derive(Clone, Copy)]
struct Map {
    offset: usize,
    width: u32,
    height: u32,
    levels: u32,
    channels: u32,
    moments: usize,
    is_base: bool,
}

impl Map {
    /// Floats of one level.
    fn floats(&self, level: u32) -> usize {
        (self.width >> level) as usize * (self.height >> level) as usize * self.channels as usize
    }

    /// Level 0 of a gradient pyramid with a quarter of every parent added, as `adam_texels` computes it; `unit` is that
    /// of the fixed point.
    #[cfg(test)]
    fn pulled(&self, all: &[i32], unit: f32) -> Vec<f32> {
        let channels = self.channels as usize;
        let mut end = self.offset + (0..self.levels).map(|level| self.floats(level)).sum::<usize>();
        let mut coarser: Vec<f32> = vec![];
        for level in (0..self.levels).rev() {
            let start = end - self.floats(level);
            let width = (self.width >> level) as usize;
            let parent = |i: usize| {
                let (row, column, channel) = (i / channels / width, i / channels % width, i % channels);
                (row / 2 * (width / 2) + column / 2) * channels + channel
            };
            let inherited = |i: usize| if coarser.is_empty() { 0.0 } else { 0.25 * coarser[parent(i)] };
            let own = all[start..end].iter().enumerate();
            coarser = own.map(|(i, &g)| g as f32 + inherited(i)).collect();
            end = start;
        }
        coarser.into_iter().map(|g| unit * g).collect()
    }

    /// Words of `Map` in shaders/shared/map.wgsl.
    fn words(&self, level: u32) -> [u32; 8] {
        let (offset, moments) = (self.offset as u32, self.moments as u32);
        [offset, self.width, self.height, self.levels, self.channels, moments, level, u32::from(self.is_base)]
    }
}

/// Buffers of one kind of map: base or bands.
struct Pool {
    texels: Buffer,
    /// One per mesh; None where a mesh has no bands.
    maps: Vec<Option<Map>>,
    /// Level, `build_mips` stage and threads, for every level of every map except level 0, fine to coarse.
    mips: Vec<(u32, Stage, usize)>,
    /// If trainable.
    adam: Option<TexelAdam>,
}

/// Gradients and moments of one kind of map, and the steps of Adam that they take.
struct TexelAdam {
    gradients: Buffer,
    moments: Buffer,
    /// `adam_texels` stage and threads for every map.
    stages: Vec<(Stage, usize)>,
}

struct Kernels {
    mips: Kernel,
    adam: Kernel,
}

/// A uniform with the words of `map` for a kernel that writes `level`.
fn uniform(gpu: &Gpu, map: &Map, level: u32) -> Result<Buffer, GpuError> {
    let words = map.words(level);
    let buffer = gpu.uniform("map", words.len())?;
    gpu.write(&buffer, 0, &words);
    Ok(buffer)
}

impl Pool {
    /// Uploads level 0 of `textures` (one per mesh) and lays out the rest.
    fn new(
        gpu: &Gpu,
        kernels: &Kernels,
        [step, peaks]: [&Buffer; 2],
        (label, is_base): (&str, bool),
        textures: &[Option<&Texture>],
        status: Option<&Buffer>,
    ) -> Result<Self, GpuError> {
        let (mut offset, mut moments, mut maps) = (0, 0, vec![]);
        for texture in textures {
            let Some(t) = texture else {
                maps.push(None);
                continue;
            };
            let (width, height, levels, channels) = (t.width(), t.height(), t.mip_levels(), t.channels());
            let map = Map { offset, width, height, levels, channels, moments, is_base };
            offset += (0..levels).map(|l| map.floats(l)).sum::<usize>();
            moments += map.floats(0);
            maps.push(Some(map));
        }
        let texels = gpu.storage(label, offset)?;
        let mut mips = vec![];
        for (map, texture) in maps.iter().zip(textures) {
            let (Some(map), Some(texture)) = (map, texture) else { continue };
            gpu.write(&texels, map.offset as u64 * 4, texture.texels());
            for level in 1..map.levels {
                let stage = kernels.mips.bind(gpu, &[&uniform(gpu, map, level)?, &texels]);
                mips.push((level, stage, map.floats(level)));
            }
        }
        let mut pool = Self { texels, maps, mips, adam: None };
        if let Some(status) = status {
            pool.adam = Some(TexelAdam {
                gradients: gpu.storage("mesh texel gradients", offset)?,
                moments: gpu.storage("mesh texel moments", 2 * moments)?,
                stages: vec![],
            });
            pool.bind_adam(gpu, kernels, [step, status, peaks])?;
        }
        Ok(pool)
    }

    fn bind_adam(&mut self, gpu: &Gpu, kernels: &Kernels, [step, status, peaks]: [&Buffer; 3]) -> Result<(), GpuError> {
        let Some(adam) = &mut self.adam else { return Ok(()) };
        for map in self.maps.iter().flatten() {
            let uniform = uniform(gpu, map, 0)?;
            let buffers = [&uniform, step, &adam.gradients, &self.texels, &adam.moments, status, peaks];
            // A thread updates the floats whose mean is one float of level 1.
            let threads = map.floats(1.min(map.levels - 1));
            adam.stages.push((kernels.adam.bind(gpu, &buffers), threads));
        }
        Ok(())
    }

    /// Total floats of all pyramids.
    fn floats(&self) -> usize {
        self.maps.iter().flatten().map(|m| (0..m.levels).map(|l| m.floats(l)).sum::<usize>()).sum()
    }

    /// Level 0 of every map.
    fn read_texels(&self, gpu: &Gpu) -> Result<Vec<Vec<f32>>, GpuError> {
        let all: Vec<f32> = gpu.read(&self.texels, self.floats())?;
        let level_0 = |map: &Option<Map>| map.map_or(vec![], |m| all[m.offset..m.offset + m.floats(0)].to_vec());
        Ok(self.maps.iter().map(level_0).collect())
    }

    /// Gradients of every map, including those of coarser levels.
    #[cfg(test)]
    fn read_gradients(&self, gpu: &Gpu, unit: f32) -> Result<Vec<Vec<f32>>, GpuError> {
        let Some(adam) = &self.adam else { return Ok(vec![]) };
        let all: Vec<i32> = gpu.read(&adam.gradients, self.floats())?;
        Ok(self.maps.iter().map(|map| map.map_or(vec![], |m| m.pulled(&all, unit))).collect())
    }

    /// Number of pairs of moments: floats of all level-0 maps.
    fn moments(&self) -> usize {
        self.maps.iter().flatten().map(|m| m.floats(0)).sum()
    }
}

/// Maps of all meshes on the adapter.
pub(crate) struct Texels {
    base: Pool,
    bands: Pool,
    degrees: Vec<u32>,
    step: Buffer,
    peaks: Buffer,
}

impl Texels {
    /// Uploads the maps of `meshes` and builds their mips; a step's `status` adds gradients and moments, all zero.
    ///
    /// # Errors
    /// If a buffer exceeds what the adapter binds.
    pub(crate) fn new(gpu: &Gpu, meshes: &[Mesh], status: Option<&Buffer>) -> Result<Self, GpuError> {
        let kernels = Kernels {
            mips: Kernel::new(gpu, "build_mips.wgsl", "build", &gpu.defines()),
            adam: Kernel::new(gpu, "adam_texels.wgsl", "adam", &adam::defines(gpu)),
        };
        let step = gpu.uniform("texel step", 8)?;
        let peaks = gpu.storage("gradient peaks", PEAKS)?;
        let shared = [&step, &peaks];
        let base: Vec<_> = meshes.iter().map(|m| Some(m.atlas().base())).collect();
        let bands: Vec<_> = meshes.iter().map(|m| m.atlas().bands()).collect();
        let texels = Self {
            base: Pool::new(gpu, &kernels, shared, ("mesh base texels", true), &base, status)?,
            bands: Pool::new(gpu, &kernels, shared, ("mesh band texels", false), &bands, status)?,
            degrees: meshes.iter().map(|m| m.atlas().sh_degree()).collect(),
            step,
            peaks,
        };
        let mut frame = Frame::new(gpu);
        texels.record_mips(&mut frame, 1);
        frame.submit();
        Ok(texels)
    }

    /// Words of `array<Maps>` in `shaders/shared/mesh_fragment.wgsl`.
    pub(crate) fn table(&self) -> Vec<u32> {
        let mut words = vec![];
        for ((base, bands), &degree) in self.base.maps.iter().zip(&self.bands.maps).zip(&self.degrees) {
            let pyramid = |map: &Option<Map>, unit: usize| {
                map.map_or([0, 1, 1, 1], |m| [(m.offset / unit) as u32, m.levels, m.width, m.height])
            };
            words.extend(pyramid(base, 4));
            // Bands are addressed in floats from their own offset, texels from 0, since a texel's length is no power of
            // two.
            words.extend(pyramid(&bands.map(|m| Map { offset: 0, ..m }), 1));
            words.extend([bands.map_or(0, |m| m.offset as u32), degree, 0, 0]);
        }
        words
    }

    /// Largest number of SH coefficients above the zeroth of any mesh.
    pub(crate) fn band_coefficients(&self) -> u32 {
        self.degrees.iter().map(|&d| sh::coefficients(d) as u32 - 1).max().unwrap_or(0)
    }

    /// Whether every texel of the bands begins at a multiple of four floats.
    pub(crate) fn bands_are_in_fours(&self) -> bool {
        self.bands.maps.iter().flatten().all(|map| map.channels % 4 == 0)
    }

    /// Zeroth coefficients and opacity logits, `[texels, 4]`.
    pub(crate) fn base(&self) -> &Buffer {
        &self.base.texels
    }

    /// Higher bands.
    pub(crate) fn bands(&self) -> &Buffer {
        &self.bands.texels
    }

    /// Scales of sums in fixed point, see `shaders/shared/fixed_point.wgsl`.
    pub(crate) fn peaks(&self) -> &Buffer {
        &self.peaks
    }

    /// Gradients of `base` and `bands`, if trainable, in fixed point.
    pub(crate) fn gradients(&self) -> Option<(&Buffer, &Buffer)> {
        Some((&self.base.adam.as_ref()?.gradients, &self.bands.adam.as_ref()?.gradients))
    }

    /// Those of `base` and `bands`, if trainable.
    fn adam(&self) -> impl Iterator<Item = &TexelAdam> {
        [&self.base, &self.bands].into_iter().filter_map(|p| p.adam.as_ref())
    }

    /// Appends the rebuilding of all levels from `first` (at least 1) on, each from the one before.
    fn record_mips(&self, frame: &mut Frame, first: u32) {
        let mips = self.base.mips.iter().chain(&self.bands.mips);
        for (_, stage, threads) in mips.filter(|(level, ..)| *level >= first) {
            frame.dispatch_threads(stage, *threads);
        }
    }

    /// Appends the zeroing of the gradients of all levels and of the peaks.
    pub(crate) fn record_zero_gradients(&self, frame: &mut Frame) {
        frame.clear(&self.peaks);
        for adam in self.adam() {
            frame.clear(&adam.gradients);
        }
    }

    /// Parameters of the next Adam step; takes effect before the next submission.
    pub(crate) fn set_step(&self, gpu: &Gpu, step: &TexelStep) {
        gpu.write(&self.step, 0, &step.words());
    }

    /// Appends a step of Adam on level 0, by the gradients of all levels, which also writes level 1, and the rebuilding
    /// of the other mips, so that they always match.
    pub(crate) fn record_adam(&self, frame: &mut Frame) {
        for (stage, threads) in self.adam().flat_map(|adam| &adam.stages) {
            frame.dispatch_threads(stage, *threads);
        }
        self.record_mips(frame, 2);
    }

    /// Reads the maps, one atlas per mesh. Waits.
    ///
    /// # Errors
    /// If the driver failed or a texel is not finite.
    pub(crate) fn read_atlases(&self, gpu: &Gpu) -> Result<Vec<Atlas>, GpuError> {
        let texture =
            |map: &Option<Map>, texels| map.map(|m| Texture::new(m.width, m.height, m.channels, texels)).transpose();
        let (base, bands) = (self.base.read_texels(gpu)?, self.bands.read_texels(gpu)?);
        let atlas = |(i, (base, bands))| {
            let base = texture(&self.base.maps[i], base)?.expect("every mesh has a base map");
            Atlas::new(base, texture(&self.bands.maps[i], bands)?)
        };
        let atlases: Result<_, SceneError> = base.into_iter().zip(bands).enumerate().map(atlas).collect();
        atlases.map_err(|e| GpuError::Failed { adapter: gpu.adapter().to_owned(), reason: format!("mesh {e}") })
    }

    /// Gradients by the parameters, coarse levels included, per mesh; empty if not trainable.
    ///
    /// # Errors
    /// If the driver failed.
    #[cfg(test)]
    pub(crate) fn read_gradients(&self, gpu: &Gpu) -> Result<Vec<AtlasGradient>, GpuError> {
        let words: Vec<u32> = gpu.read(&self.peaks, PEAKS)?;
        let (largest, crowded) = (f32::from_bits(words[0]), f32::from_bits(words[2]));
        let unit = largest.max(crowded.min(largest * (words[3] as f32 / CROWD))) / FIXED_ONE;
        let bands = self.bands.read_gradients(gpu, BAND_UNIT * unit)?;
        Ok(self.base.read_gradients(gpu, unit)?.into_iter().zip(bands).collect())
    }

    /// Adam's first and second moments: the base maps of all meshes, then the bands of all meshes, each laid out like
    /// its level 0. Empty if not trainable.
    ///
    /// # Errors
    /// If the driver failed.
    pub(crate) fn read_moments(&self, gpu: &Gpu) -> Result<(Vec<f32>, Vec<f32>), GpuError> {
        let mut pairs: Vec<[f32; 2]> = vec![];
        for pool in [&self.base, &self.bands] {
            if let Some(adam) = &pool.adam {
                pairs.extend(gpu.read::<[f32; 2]>(&adam.moments, pool.moments())?);
            }
        }
        Ok(pairs.into_iter().map(|[m, v]| (m, v)).unzip())
    }

    /// Replaces the moments by ones that `read_moments` returned for the same meshes. False, and nothing changes, if
    /// the lengths do not fit.
    pub(crate) fn write_moments(&self, gpu: &Gpu, first: &[f32], second: &[f32]) -> bool {
        let (base, bands) = (self.base.moments(), self.bands.moments());
        if self.gradients().is_none() || first.len() != base + bands || second.len() != first.len() {
            return false;
        }
        let pairs: Vec<[f32; 2]> = first.iter().zip(second).map(|(&m, &v)| [m, v]).collect();
        for (adam, part) in self.adam().zip([&pairs[..base], &pairs[base..]]) {
            gpu.write(&adam.moments, 0, part);
        }
        true
    }
}

#[cfg(test)]
mod tests;
