//! The Adam optimiser: its constants (`shaders/shared/adam.wgsl`), and its steps for splats
//! (`shaders/adam_splats.wgsl`).

use super::{
    device::{Buffer, Frame, Gpu, GpuError, Stage},
    shader::Defines,
    status::with_not_finite,
};
use crate::scene::sh;

/// β₁ and β₂: decay factors of the moments (INRIA 3DGS, `scene/gaussian_model.py`).
const BETAS: [f64; 2] = [0.9, 0.999];
/// Term added to the root of the second moment (ibid.).
const EPSILON: f64 = 1e-15;

/// Defines for every kernel that takes steps of Adam.
pub(super) fn defines(gpu: &Gpu) -> Defines {
    let [beta_1, beta_2] = BETAS;
    with_not_finite(gpu.defines())
        .with_real("BETA_1", beta_1)
        .with_real("BETA_2", beta_2)
        .with_real("GAIN_1", 1.0 - beta_1)
        .with_real("GAIN_2", 1.0 - beta_2)
        .with_real("EPSILON", EPSILON)
}

/// Buffers of the splats' parameters, gradients or moments, which share one layout.
#[derive(Clone, Copy)]
pub(crate) struct SplatFloats<'a> {
    /// Geometry, `array<vec4f>` `[N·3]`: mean and opacity logit; quaternion w, x, y, z; log-scale and the deviation of
    /// smoothing.
    pub(crate) geometry: &'a Buffer,
    /// SH coefficients, `array<f32>` `[N·(degree+1)²·3]`.
    pub(crate) sh: &'a Buffer,
}

/// Buffers that steps of [`SplatAdam`] read and write.
pub(crate) struct AdamBuffers<'a> {
    pub(crate) parameters: SplatFloats<'a>,
    pub(crate) gradient: SplatFloats<'a>,
    /// First and second moments.
    pub(crate) moments: [SplatFloats<'a>; 2],
    /// `array<u32>` `[N]`, non-zero for a splat that the view sees.
    pub(crate) visible: &'a Buffer,
    /// Status of the step (`shared/status.wgsl`).
    pub(crate) status: &'a Buffer,
}

/// Learning rates of the splats' parameters.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct SplatRates {
    /// Means, world units.
    pub(crate) mean: f32,
    /// Opacity logits.
    pub(crate) opacity: f32,
    /// Quaternions.
    pub(crate) rotation: f32,
    /// Log-scales.
    pub(crate) log_scale: f32,
    /// SH coefficient 0.
    pub(crate) sh_dc: f32,
    /// All other SH coefficients.
    pub(crate) sh_rest: f32,
}

/// Parameters of one Adam step on splats.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct AdamStep {
    /// Number of the step, from 1, for the bias correction of the moments.
    pub(crate) number: u32,
    pub(crate) n_splats: u32,
    /// Active SH degree; coefficients above it are not updated.
    pub(crate) sh_degree: u32,
    pub(crate) rates: SplatRates,
    /// Weight of the mean opacity in the loss (MCMC: 0.01).
    pub(crate) opacity_weight: f32,
    /// Weight of the mean scale in the loss (MCMC: 0.01).
    pub(crate) scale_weight: f32,
    /// MCMC's noise on means, relative to their rate (there 5e5); 0 for none.
    pub(crate) noise: f32,
    pub(crate) seed: u32,
    /// Update only splats that this view sees.
    pub(crate) visible_only: bool,
}

/// Bias corrections 1 − β₁ᵗ and 1 − β₂ᵗ, by which step t divides the moments.
pub(super) fn bias_corrections(step: u32) -> [f32; 2] {
    BETAS.map(|beta| (1.0 - beta.powf(f64::from(step.max(1)))) as f32)
}

/// Adam for one set of splat buffers.
pub(crate) struct SplatAdam {
    geometry: Stage,
    harmonics: Stage,
    uniform: Buffer,
    n_splats: usize,
    /// SH floats per thread.
    lanes: usize,
    active_floats: usize,
}

impl SplatAdam {
    /// Stages for splats with `sh_floats` = 3·(degree+1)² SH floats each. [`Self::set`] must precede recording.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn new(gpu: &Gpu, sh_floats: usize, buffers: &AdamBuffers) -> Result<Self, GpuError> {
        let &AdamBuffers { parameters, gradient, moments: [first_moment, second_moment], visible, status } = buffers;
        let uniform = gpu.uniform("Adam step", 16)?;
        let lanes = if sh_floats.is_multiple_of(4) { 4 } else { 1 };
        let defines = defines(gpu).with("SH_FLOATS", sh_floats as u32).with("FOURS", u32::from(lanes == 4));
        let sets = [parameters, gradient, first_moment, second_moment];
        let stage = |entry, is_geometry: bool| {
            let defines = defines.clone().with("GEOMETRY", u32::from(is_geometry));
            let [p, g, m, v] = sets.map(|s| if is_geometry { s.geometry } else { s.sh });
            Stage::new(gpu, "adam_splats.wgsl", entry, &defines, &[&uniform, visible, p, g, m, v, status])
        };
        let (geometry, harmonics) = (stage("geometry", true), stage("harmonics", false));
        Ok(Self { geometry, harmonics, uniform, n_splats: 0, lanes, active_floats: 3 })
    }

    /// Sets the step of frames recorded from now on.
    pub(crate) fn set(&mut self, gpu: &Gpu, step: &AdamStep) {
        self.n_splats = step.n_splats as usize;
        self.active_floats = 3 * sh::coefficients(step.sh_degree);
        let [first, second] = bias_corrections(step.number);
        let n = step.n_splats.max(1) as f32;
        let r = &step.rates;
        let floats = [
            r.mean,
            r.opacity,
            r.rotation,
            r.log_scale,
            r.sh_dc,
            r.sh_rest,
            step.opacity_weight / n,
            step.scale_weight / (3.0 * n),
        ];
        let mut words = [0; 16];
        words[..4].copy_from_slice(&[step.n_splats, step.number, step.seed, u32::from(step.visible_only)]);
        words[4..7].copy_from_slice(&[first, second, step.noise * r.mean].map(f32::to_bits));
        words[7] = self.active_floats as u32;
        words[8..].copy_from_slice(&floats.map(f32::to_bits));
        gpu.write(&self.uniform, 0, &words);
    }

    /// Appends the step to a frame.
    pub(crate) fn record(&self, frame: &mut Frame) {
        frame.dispatch_threads(&self.geometry, self.n_splats);
        let threads = self.n_splats * self.active_floats.div_ceil(self.lanes);
        frame.dispatch_threads(&self.harmonics, threads);
    }
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DQuat, DVec3};
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;

    use super::*;
    use crate::render::gpu::status::status_buffer;

    /// Number of SH floats for degree 1, which are updated four at a time, and for degree 2, which are not.
    const SH_FLOATS: [usize; 2] = [12, 27];
    const RATES: SplatRates =
        SplatRates { mean: 1e-3, opacity: 0.05, rotation: 2e-3, log_scale: 5e-3, sh_dc: 2.5e-3, sh_rest: 1.25e-4 };
    const STEP: AdamStep = AdamStep {
        number: 1,
        n_splats: 0,
        sh_degree: 2,
        rates: RATES,
        opacity_weight: 0.0,
        scale_weight: 0.0,
        noise: 0.0,
        seed: 7,
        visible_only: false,
    };

    /// Parameters, gradients, first and second moments: geometry `[N·12]`, SH `[N·sh_floats]`.
    struct State {
        geometry: [Buffer; 4],
        sh: [Buffer; 4],
        visible: Buffer,
        status: Buffer,
        n: usize,
        sh_floats: usize,
    }

    impl State {
        fn new(gpu: &Gpu, geometry: &[f32], sh: &[f32]) -> Self {
            let set = |values: &[f32]| {
                [0, 1, 2, 3].map(|i| {
                    let buffer = gpu.storage("set", values.len()).unwrap();
                    gpu.write(&buffer, 0, if i == 0 { values } else { &[] });
                    buffer
                })
            };
            let n = geometry.len() / 12;
            Self {
                geometry: set(geometry),
                sh: set(sh),
                visible: gpu.storage("visible", n).unwrap(),
                status: status_buffer(gpu).unwrap(),
                n,
                sh_floats: sh.len() / n,
            }
        }

        fn adam(&self, gpu: &Gpu) -> SplatAdam {
            let [p, g, m, v] = [0, 1, 2, 3].map(|i| SplatFloats { geometry: &self.geometry[i], sh: &self.sh[i] });
            let Self { visible, status, .. } = self;
            let buffers = AdamBuffers { parameters: p, gradient: g, moments: [m, v], visible, status };
            SplatAdam::new(gpu, self.sh_floats, &buffers).unwrap()
        }

        fn run(&self, gpu: &Gpu, adam: &mut SplatAdam, step: AdamStep) {
            let sh_degree = step.sh_degree.min(if self.sh_floats == 12 { 1 } else { 2 });
            adam.set(gpu, &AdamStep { n_splats: self.n as u32, sh_degree, ..step });
            let mut frame = Frame::new(gpu);
            adam.record(&mut frame);
            frame.submit();
        }

        fn read(&self, gpu: &Gpu, i: usize) -> (Vec<f32>, Vec<f32>) {
            (gpu.read(&self.geometry[i], self.n * 12).unwrap(), gpu.read(&self.sh[i], self.n * self.sh_floats).unwrap())
        }
    }

    fn random(n: usize, rng: &mut Pcg32) -> Vec<f32> {
        (0..n).map(|_| rng.random_range(-1.0..1.0)).collect()
    }

    #[test]
    fn twenty_steps_equal_adam_in_f64() {
        SH_FLOATS.into_iter().for_each(assert_equals_adam);
    }

    fn assert_equals_adam(sh_floats: usize) {
        let gpu = Gpu::open(None).unwrap();
        let mut rng = Pcg32::seed_from_u64(3);
        let n = 300; // more than a workgroup
        let (geometry, sh) = (random(n * 12, &mut rng), random(n * sh_floats, &mut rng));
        let state = State::new(&gpu, &geometry, &sh);
        let mut adam = state.adam(&gpu);
        // Weights large enough for the regularisers to matter beside gradients of order 1.
        let step = AdamStep { opacity_weight: 400.0, scale_weight: 300.0, ..STEP };

        let mut p: Vec<f64> = geometry.iter().chain(&sh).map(|&v| f64::from(v)).collect();
        let start = p.clone();
        let (mut m, mut v) = (vec![0.0; p.len()], vec![0.0; p.len()]);
        let rate = |i: usize| {
            f64::from(match i.checked_sub(n * 12) {
                Some(j) if j % sh_floats < 3 => RATES.sh_dc,
                Some(_) => RATES.sh_rest,
                None => match i % 12 {
                    0..3 => RATES.mean,
                    3 => RATES.opacity,
                    4..8 => RATES.rotation,
                    8..11 => RATES.log_scale,
                    _ => 0.0,
                },
            })
        };
        for t in 1..=20 {
            // Gradient magnitudes span twelve decades, to which Adam must be invariant.
            let mut gradient = random(p.len(), &mut rng);
            for (i, g) in gradient.iter_mut().enumerate() {
                let regularised = i < n * 12 && matches!(i % 12, 3 | 8..11);
                *g *= if regularised { 1.0 } else { 10f32.powi(-(i as i32 % 13)) };
            }
            // Each splat is visible in two of three steps. Otherwise its gradient counts as zero, whatever the buffer
            // contains.
            let splat_of = |i: usize| i.checked_sub(n * 12).map_or(i / 12, |j| j / sh_floats);
            let is_visible = |splat: usize| !(splat + t as usize).is_multiple_of(3);
            gpu.write(&state.visible, 0, &(0..n).map(|splat| u32::from(is_visible(splat))).collect::<Vec<_>>());
            let unseen = (0..gradient.len()).filter(|i| !is_visible(splat_of(*i)));
            unseen.for_each(|i| gradient[i] = f32::NAN);
            gpu.write(&state.geometry[1], 0, &gradient[..n * 12]);
            gpu.write(&state.sh[1], 0, &gradient[n * 12..]);
            state.run(&gpu, &mut adam, AdamStep { number: t, ..step });
            for i in 0..p.len() {
                let mut g = if is_visible(splat_of(i)) { f64::from(gradient[i]) } else { 0.0 };
                if i < n * 12 {
                    let o = 1.0 / (1.0 + (-p[i]).exp());
                    match i % 12 {
                        3 => g += 400.0 / n as f64 * o * (1.0 - o),
                        8..11 => g += 300.0 / (3 * n) as f64 * p[i].exp(),
                        _ => {}
                    }
                }
                m[i] = 0.9 * m[i] + 0.1 * g;
                v[i] = 0.999 * v[i] + 0.001 * g * g;
                let (c1, c2) = (1.0 - 0.9f64.powi(t as i32), 1.0 - 0.999f64.powi(t as i32));
                p[i] -= rate(i) * (m[i] / c1) / ((v[i] / c2).sqrt() + 1e-15);
            }
        }
        let (geometry, sh) = state.read(&gpu, 0);
        for (i, found) in geometry.into_iter().chain(sh).enumerate() {
            // Relative to the distance of twenty full steps, plus the rounding of twenty sums.
            let tolerance = 1e-4 * 20.0 * rate(i) + 20.0 * f64::from(f32::EPSILON) * start[i].abs();
            let error = (f64::from(found) - p[i]).abs();
            assert!(error <= tolerance, "float {i}: {found}, not {} (from {})", p[i], start[i]);
        }
    }

    #[test]
    fn noise_has_the_splats_shape() {
        let gpu = Gpu::open(None).unwrap();
        let n = 40_000;
        let opacity = 0.01f64;
        let quaternion = DQuat::from_euler(glam::EulerRot::XYZ, 0.4, -0.7, 1.1);
        let q = quaternion * 1.7; // of any norm
        let scale = DVec3::new(0.3, 0.1, 0.02);
        let splat = [
            0.0,
            0.0,
            0.0,
            (opacity / (1.0 - opacity)).ln(),
            q.w,
            q.x,
            q.y,
            q.z,
            scale.x.ln(),
            scale.y.ln(),
            scale.z.ln(),
            0.0,
        ];
        let geometry: Vec<f32> = splat.iter().map(|&v| v as f32).cycle().take(n * 12).collect();
        let deltas = [1, 2].map(|number| {
            let state = State::new(&gpu, &geometry, &vec![0.0; n * SH_FLOATS[0]]);
            state.run(&gpu, &mut state.adam(&gpu), AdamStep { number, noise: 5e5, ..STEP });
            let found = state.read(&gpu, 0).0;
            let rest = |v: &[f32]| v.chunks(12).flat_map(|s| s[3..].to_vec()).collect::<Vec<_>>();
            assert_eq!(rest(&found), rest(&geometry), "only means move");
            found.chunks(12).map(|s| DVec3::new(s[0].into(), s[1].into(), s[2].into())).collect::<Vec<_>>()
        });

        let r = DMat3::from_quat(quaternion);
        let covariance = r * DMat3::from_diagonal(scale * scale) * r.transpose();
        let strength = 5e5 * f64::from(RATES.mean) / (1.0 + (100.0 * (opacity - 0.005)).exp());
        // In the basis in which Σ3·ξ is white, so that all axes have equal weight.
        let white = (covariance * strength).inverse();
        let xi = deltas.map(|d| d.into_iter().map(|d| white * d).collect::<Vec<_>>());
        let mean_of = |f: &dyn Fn(usize) -> f64| (0..n).map(f).sum::<f64>() / n as f64;
        let bound = 5.0 / (n as f64).sqrt(); // five standard errors
        for a in 0..3 {
            assert!(mean_of(&|i| xi[0][i][a]).abs() < bound, "mean of axis {a}");
            assert!((mean_of(&|i| xi[0][i][a].powi(4)) - 3.0).abs() < 10.0 * bound, "fourth moment of axis {a}");
            for b in 0..3 {
                let expected = if a == b { 1.0 } else { 0.0 };
                let found = mean_of(&|i| xi[0][i][a] * xi[0][i][b]);
                assert!((found - expected).abs() < 1.5 * bound, "covariance {a}{b}: {found}");
                assert!(mean_of(&|i| xi[0][i][a] * xi[1][i][b]).abs() < bound, "steps are independent");
                assert!(mean_of(&|i| xi[0][i][a] * xi[0][(i + 1) % n][b]).abs() < bound, "splats are independent");
            }
        }
    }

    #[test]
    fn unseen_splats_and_inactive_coefficients_stay() {
        SH_FLOATS.into_iter().for_each(assert_stay);
    }

    fn assert_stay(sh_floats: usize) {
        let gpu = Gpu::open(None).unwrap();
        let mut rng = Pcg32::seed_from_u64(5);
        let n = 100;
        let state = State::new(&gpu, &random(n * 12, &mut rng), &random(n * sh_floats, &mut rng));
        for set in [1, 2, 3] {
            // Gradients are larger than moments, so that visible splats change by more than rounding.
            let least = if set == 1 { 10.0 } else { 0.0 };
            let mut values = |count| random(count, &mut rng).iter().map(|v| least + v.abs()).collect::<Vec<_>>();
            gpu.write(&state.geometry[set], 0, &values(n * 12));
            gpu.write(&state.sh[set], 0, &values(n * sh_floats));
        }
        gpu.write(&state.visible, 0, &(0..n as u32).map(|i| i % 3).collect::<Vec<_>>());
        let before = [0, 2, 3].map(|set| state.read(&gpu, set));
        let step = AdamStep { number: 4, sh_degree: 0, noise: 5e5, visible_only: true, ..STEP };
        state.run(&gpu, &mut state.adam(&gpu), step);
        for (set, before) in [0, 2, 3].into_iter().zip(before) {
            let after = state.read(&gpu, set);
            for i in 0..n {
                let seen = i % 3 != 0;
                for k in (0..12).filter(|&k| k != 11 || set != 0) {
                    let changed = after.0[12 * i + k] != before.0[12 * i + k];
                    assert_eq!(changed, seen, "set {set}, splat {i}, geometry {k}");
                }
                for k in 0..sh_floats {
                    let changed = after.1[sh_floats * i + k] != before.1[sh_floats * i + k];
                    assert_eq!(changed, seen && k < 3, "set {set}, splat {i}, SH {k}");
                }
            }
        }
    }
}
