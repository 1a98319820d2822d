//! Many consecutive steps of texels, compared with Adam in f64.

use glam::{Vec2, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::*;
use crate::render::gpu::status::{Status, status_buffer};

/// β₁ and β₂ as rounded to f32; new values are weighted by 1 minus these.
const BETAS: [f32; 2] = [0.9, 0.999];
const RATES: [f32; 2] = [0.1, 0.05];
const STEPS: u32 = 20;

/// A mesh with maps of these sizes, the bands of degree 1.
fn mesh(base: [u32; 2], bands: Option<[u32; 2]>, rng: &mut Pcg32) -> Mesh {
    let mut texture = |[width, height]: [u32; 2], channels: u32, reach: f32| {
        let texels = (0..width * height * channels).map(|_| rng.random_range(-reach..reach)).collect();
        Texture::new(width, height, channels, texels).unwrap()
    };
    // Opacity logits are clamped to ±6, and some begin outside.
    let base = texture(base, 4, 7.0);
    let atlas = Atlas::new(base, bands.map(|size| texture(size, 9, 1.0))).unwrap();
    Mesh::new(vec![Vec3::ZERO, Vec3::X, Vec3::Y], vec![[0, 1, 2]], vec![[Vec2::ZERO; 3]], atlas).unwrap()
}

/// Level 0 of a map and its moments, computed on the host.
struct Host {
    map: Map,
    values: Vec<f64>,
    moments: Vec<[f64; 2]>,
}

impl Host {
    fn new(map: Map, texture: &Texture) -> Self {
        let values: Vec<f64> = texture.texels().iter().copied().map(f64::from).collect();
        Self { map, moments: vec![[0.0; 2]; values.len()], values }
    }

    /// All maps of one kind.
    fn all(pool: &Pool, textures: impl Iterator<Item = Option<Texture>>) -> Vec<Self> {
        let maps = pool.maps.iter().zip(textures);
        maps.filter_map(|(map, texture)| Some(Self::new((*map)?, &texture?))).collect()
    }

    fn level(&self, level: u32) -> usize {
        self.map.offset + (0..level).map(|finer| self.map.floats(finer)).sum::<usize>()
    }

    /// Gradient of float `i` in fixed-point units: its own, plus its share of each coarser texel that contains it.
    fn gradient(&self, all: &[i32], i: usize) -> f64 {
        let (channels, width) = (self.map.channels as usize, self.map.width as usize);
        let (row, column, channel) = (i / channels / width, i / channels % width, i % channels);
        let of_level = |level: u32| {
            let texel = (row >> level) * (width >> level) + (column >> level);
            f64::from(all[self.level(level) + texel * channels + channel]) * 0.25_f64.powi(level as i32)
        };
        (0..self.map.levels).map(of_level).sum()
    }

    fn step(&mut self, step: &TexelStep, gradients: &[i32], unit: f64) {
        let [beta_1, beta_2] = BETAS.map(f64::from);
        let t = step.number as i32;
        let corrections = if step.visited_only { [1.0; 2] } else { [0.9_f64, 0.999].map(|beta| 1.0 - beta.powi(t)) };
        let rate = f64::from(if self.map.is_base { step.base_rate } else { step.band_rate });
        for i in 0..self.values.len() {
            let (g, [m, v]) = (unit * self.gradient(gradients, i), self.moments[i]);
            if g == 0.0 && (step.visited_only || [m, v] == [0.0; 2]) {
                continue;
            }
            let (m, v) = (beta_1 * m + (1.0 - beta_1) * g, beta_2 * v + (1.0 - beta_2) * g * g);
            self.moments[i] = [m, v];
            let mut moved = m / corrections[0] / ((v / corrections[1]).sqrt() + 1e-15);
            if step.visited_only {
                moved = moved.clamp(-1.0, 1.0);
            }
            self.values[i] -= rate * moved;
            if self.map.is_base && i % 4 == 3 {
                self.values[i] = self.values[i].clamp(-6.0, 6.0);
            }
        }
    }

    /// Compares level 0 and its moments, and every other level with the means of the level below.
    fn check(&self, texels: &[f32], moments: &[[f32; 2]], case: &str) {
        let rate = f64::from(RATES[usize::from(!self.map.is_base)]);
        // All steps at the full rate, plus rounding in sums of up to 6.
        let tolerance = f64::from(STEPS) * (1e-5 * rate + 6.0 * f64::from(f32::EPSILON));
        for (i, (value, [m, v])) in self.values.iter().zip(&self.moments).enumerate() {
            let (found, [found_m, found_v]) =
                (texels[self.map.offset + i], moments[self.map.moments + i].map(f64::from));
            assert!((f64::from(found) - value).abs() < tolerance, "{case}, float {i}: {found}, not {value}");
            assert!((found_m - m).abs() <= 2e-5 * v.sqrt(), "{case}, float {i}: first moment {found_m}, not {m}");
            assert!((found_v - v).abs() <= 2e-5 * v, "{case}, float {i}: second moment {found_v}, not {v}");
        }
        for level in 1..self.map.levels {
            let (channels, width) = (self.map.channels as usize, (self.map.width >> level) as usize);
            let finer = &texels[self.level(level - 1)..];
            for i in 0..self.map.floats(level) {
                let (row, column, channel) = (i / channels / width, i / channels % width, i % channels);
                let at = |y: usize, x: usize| {
                    f64::from(finer[((2 * row + y) * 2 * width + 2 * column + x) * channels + channel])
                };
                let mean = 0.25 * (at(0, 0) + at(0, 1) + at(1, 0) + at(1, 1));
                let found = f64::from(texels[self.level(level) + i]);
                assert!((found - mean).abs() < 3e-6, "{case}, float {i} of level {level}: {found}, not {mean}");
            }
        }
    }
}

/// In every second step or more, a float gets no gradient of its own, and gradients change sign.
#[test]
fn twenty_steps_equal_adam_in_f64() {
    for visited_only in [false, true] {
        let (gpu, mut rng) = (Gpu::open(None).unwrap(), Pcg32::seed_from_u64(9));
        let meshes = [
            mesh([32, 16], Some([8, 16]), &mut rng),
            mesh([5, 3], None, &mut rng),
            mesh([6, 10], Some([2, 4]), &mut rng),
        ];
        let status = status_buffer(&gpu).unwrap();
        let texels = Texels::new(&gpu, &meshes, Some(&status)).unwrap();
        let base = Host::all(&texels.base, meshes.iter().map(|m| Some(m.atlas().base().clone())));
        let bands = Host::all(&texels.bands, meshes.iter().map(|m| m.atlas().bands().cloned()));
        let levels = |hosts: &[Host]| hosts.iter().map(|host| host.map.levels).collect::<Vec<_>>();
        assert_eq!((levels(&base), levels(&bands)), (vec![5, 1, 2], vec![4, 2]));
        let mut kinds = [(&texels.base, base, 1.0), (&texels.bands, bands, f64::from(BAND_UNIT))];
        for number in 1..=STEPS {
            // In every fifth step fragments are crowded, which doubles the fixed-point unit.
            let largest = [20.0_f32, 0.5, 3e-4][number as usize % 3];
            let (crowded, n_crowded) = if number % 5 == 0 { (8.0 * largest, 2.0 * CROWD) } else { (0.0, 0.0) };
            let peak = if number % 5 == 0 { 2.0 * largest } else { largest };
            gpu.write(&texels.peaks, 0, &[largest.to_bits(), 0, crowded.to_bits(), n_crowded as u32]);
            let [base_rate, band_rate] = RATES;
            let step = TexelStep { number, base_rate, band_rate, visited_only, holds_opacity: false };
            for (pool, hosts, of_kind) in &mut kinds {
                // Integers with few enough digits for f32 to represent the sum over all levels.
                let mut units = || if rng.random_range(0..10) < 7 { 0 } else { rng.random_range(-32_000..32_000) };
                let gradients: Vec<i32> = (0..pool.floats()).map(|_| units()).collect();
                gpu.write(&pool.adam.as_ref().unwrap().gradients, 0, &gradients);
                let unit = *of_kind * f64::from(peak) / f64::from(FIXED_ONE);
                hosts.iter_mut().for_each(|host| host.step(&step, &gradients, unit));
            }
            texels.set_step(&gpu, &step);
            let mut frame = Frame::new(&gpu);
            texels.record_adam(&mut frame);
            frame.submit();
        }
        assert_eq!(Status::read(&gpu, &status).unwrap().not_finite, None);
        let (mut moved, mut at_limit) = (0, 0);
        for (pool, hosts, _) in &kinds {
            let all: Vec<f32> = gpu.read(&pool.texels, pool.floats()).unwrap();
            let moments = &pool.adam.as_ref().unwrap().moments;
            let moments: Vec<[f32; 2]> = gpu.read(moments, pool.moments()).unwrap();
            for (i, host) in hosts.iter().enumerate() {
                let kind = if host.map.is_base { "base" } else { "bands" };
                host.check(&all, &moments, &format!("visited only {visited_only}, {kind} {i}"));
                moved += host.moments.iter().filter(|m| **m != [0.0; 2]).count();
                at_limit += host.values.iter().filter(|value| host.map.is_base && value.abs() == 6.0).count();
            }
        }
        assert!(moved > 3000 && at_limit > 3, "{moved} floats move, {at_limit} are at their limit");
    }
}
