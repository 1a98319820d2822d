//! Rearrangement of splats on the GPU, without a detour through the host (`shaders/gather_rows.wgsl`).

use super::{
    device::{Buffer, Frame, Gpu, GpuError, Kernel},
    geometry::{GEOMETRY_FLOATS, OPACITY},
};

/// Index of the splat whose SH coefficients and Adam moments another takes over, with flags.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Source(u32);

impl Source {
    const FRESH: u32 = 1 << 31;
    const FRESH_OPACITY: u32 = 1 << 30;
    const SPLAT: u32 = Self::FRESH_OPACITY - 1;

    /// Splat `i` with all its moments.
    ///
    /// # Panics
    /// If `i` is 2³⁰ or more: the geometry of as many takes 52 GB.
    pub(crate) fn new(i: usize) -> Self {
        assert!(i <= Self::SPLAT as usize, "at most 2³⁰ splats");
        Self(i as u32)
    }

    /// The same source, with all moments set to zero.
    pub(crate) fn without_moments(self) -> Self {
        Self(self.0 | Self::FRESH)
    }

    /// The same source, with the moments of the opacity set to zero.
    pub(crate) fn without_opacity_moments(self) -> Self {
        Self(self.0 | Self::FRESH_OPACITY)
    }

    /// Index of the splat.
    pub(crate) fn splat(self) -> usize {
        (self.0 & Self::SPLAT) as usize
    }

    /// [`RowGather::run`] on the host: rearranges the rows of `before`, of `width` floats each, by `sources`, according
    /// to `what` they hold.
    #[cfg(test)]
    pub(crate) fn gather(sources: &[Self], before: &[f32], width: usize, what: Rows) -> Vec<f32> {
        let mut after = Vec::with_capacity(sources.len() * width);
        for source in sources {
            let at = after.len();
            after.extend_from_slice(&before[source.splat() * width..][..width]);
            match what {
                Rows::Parameters => {}
                _ if source.0 & Self::FRESH != 0 => after[at..].fill(0.0),
                Rows::GeometryMoments if source.0 & Self::FRESH_OPACITY != 0 => after[at + OPACITY] = 0.0,
                Rows::GeometryMoments | Rows::ShMoments => {}
            }
        }
        after
    }
}

/// Content of rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Rows {
    /// SH coefficients.
    Parameters,
    /// First or second moments of these.
    ShMoments,
    /// First or second moments of geometry.
    GeometryMoments,
}

/// Rearranges rows of splats on the GPU, touching only those that change.
pub(crate) struct RowGather {
    /// Kernels `fetch` and `place`, for `[parameters, SH moments, geometry moments]`.
    kernels: [[Kernel; 2]; 3],
    sh_floats: usize,
    size: Buffer,
}

impl RowGather {
    /// Kernels for splats with `sh_floats` = 3·(degree+1)² SH floats each.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn new(gpu: &Gpu, sh_floats: usize) -> Result<Self, GpuError> {
        let kernels = [Rows::Parameters, Rows::ShMoments, Rows::GeometryMoments].map(|what| {
            let (width, opacity) = match what {
                Rows::GeometryMoments => (GEOMETRY_FLOATS, OPACITY),
                Rows::Parameters | Rows::ShMoments => (sh_floats, sh_floats),
            };
            let defines = (gpu.defines().with("WIDTH", width as u32).with("OPACITY", opacity as u32))
                .with("HOLDS_MOMENTS", u32::from(what != Rows::Parameters))
                .with("FRESH", Source::FRESH)
                .with("FRESH_OPACITY", Source::FRESH_OPACITY)
                .with("SPLAT", Source::SPLAT);
            ["fetch", "place"].map(|entry| Kernel::new(gpu, "gather_rows.wgsl", entry, &defines))
        });
        Ok(Self { kernels, sh_floats, size: gpu.uniform("changes of rows", 4)? })
    }

    /// Rearranges the rows of every buffer by `sources`, using the buffer paired with it, of the same length, as
    /// scratch space. The cost is that of the rows that change. Does not wait.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn run(
        &self,
        gpu: &Gpu,
        sources: &[Source],
        buffers: &[(Rows, &Buffer, &Buffer)],
    ) -> Result<(), GpuError> {
        let changed = sources.iter().enumerate().filter(|(row, source)| **source != Source::new(*row));
        let changes: Vec<[u32; 2]> = changed.map(|(row, source)| [row as u32, source.0]).collect();
        if changes.is_empty() {
            return Ok(());
        }
        let list = gpu.storage_with("changes of rows", &changes)?;
        gpu.write(&self.size, 0, &[changes.len() as u32, 0, 0, 0]);
        let mut frame = Frame::new(gpu);
        for &(what, buffer, fetched) in buffers {
            let width = if what == Rows::GeometryMoments { GEOMETRY_FLOATS } else { self.sh_floats };
            for kernel in &self.kernels[what as usize] {
                let stage = kernel.bind(gpu, &[&self.size, &list, buffer, fetched]);
                frame.dispatch_threads(&stage, changes.len() * width);
            }
        }
        frame.submit();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;

    use super::*;
    use crate::{
        render::{
            gpu::{
                state::SplatState,
                training::{Training, TrainingOptions},
            },
            testing::random_scene,
        },
        scene::OrderMode,
    };

    /// Fewer splats, another order, copies, more splats than the capacity, and none: all equal the host's result bit by
    /// bit, also with folded dispatches, and where there is room for more splats than there may be.
    #[test]
    fn what_the_gpu_gathers_is_what_the_host_does() {
        let n = 300;
        for (gpu, sh_degree) in [(Gpu::open(None), 2), (Gpu::open(None).map(|gpu| gpu.narrowed(7)), 0)] {
            let gpu = gpu.unwrap();
            let sh_floats = [3, 12, 27][sh_degree as usize];
            let (scene, camera) = random_scene(3, n, 0, sh_degree, 1, OrderMode::Stable);
            let mut rng = Pcg32::seed_from_u64(11);
            let mut random = |n: usize| (0..n).map(|_| rng.random_range(0.5..1.5)).collect::<Vec<f32>>();
            let mut all = SplatState {
                sh_degree,
                geometry: random(n * GEOMETRY_FLOATS),
                sh: random(n * sh_floats),
                geometry_m: random(n * GEOMETRY_FLOATS),
                geometry_v: random(n * GEOMETRY_FLOATS),
                sh_m: random(n * sh_floats),
                sh_v: random(n * sh_floats),
            };
            // Second moments can be subnormal.
            all.sh_v.iter_mut().step_by(3).for_each(|v| *v *= f32::MIN_POSITIVE / 2.0);
            let orders: [Vec<Source>; 5] = [
                (0..n).step_by(2).map(Source::new).collect(),
                (0..n).rev().map(|i| Source::new(i).without_opacity_moments()).collect(),
                (0..n + 100)
                    .map(|i| if i < n { Source::new(i) } else { Source::new(i - n).without_moments() })
                    .collect(),
                (0..3 * n).map(|i| [Source::new(i / 3), Source::new(7).without_moments()][i % 2]).collect(),
                vec![],
            ];
            for (sources, most_splats) in orders.iter().flat_map(|order| [(order, usize::MAX), (order, 200)]) {
                let options = TrainingOptions { most_splats, ..TrainingOptions::default() };
                let mut training = Training::with_options(&gpu, &scene, &[camera], &options).unwrap();
                training.write_splats(&all).unwrap();
                training.write_statistics(&vec![1.0; 4 * n]);
                let geometry = random(sources.len() * GEOMETRY_FLOATS);
                training.rearrange(&geometry, sources).unwrap();
                let expected = all.rearranged(&geometry, sources);
                assert!(training.read_splats().unwrap() == expected, "{} of degree {sh_degree}", sources.len());
                assert_eq!(training.read_geometry().unwrap(), geometry);
                assert_eq!(training.read_statistics().unwrap(), vec![0.0; 4 * sources.len()]);
            }
        }
    }

    #[test]
    fn moments_are_kept_or_begin_anew() {
        let rows: Vec<f32> = (1..=36).map(|v| v as f32).collect();
        let sources = [Source::new(2), Source::new(1).without_moments(), Source::new(0).without_opacity_moments()];
        let gathered = |what| Source::gather(&sources, &rows, GEOMETRY_FLOATS, what);
        let parameters = gathered(Rows::Parameters);
        assert_eq!(parameters, [&rows[24..], &rows[12..24], &rows[..12]].concat());
        let mut moments = parameters;
        moments[12..24].fill(0.0);
        assert_eq!(gathered(Rows::ShMoments), moments);
        moments[24 + OPACITY] = 0.0;
        assert_eq!(gathered(Rows::GeometryMoments), moments);
        assert_eq!(sources.map(Source::splat), [2, 1, 0]);
    }
}
