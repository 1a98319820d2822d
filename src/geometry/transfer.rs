//! Resampling of a texture for the same triangles in another layout.

use glam::Vec2;

use super::raster::texels_in;
use crate::scene::{SceneError, Texture};

/// Resamples `texture`, laid out by `from` (`[F]` UVs of corners), for the same triangles laid out by `to` in a square
/// of `size` texels. Texels outside all triangles take the mean of drawn neighbours, `gutter` texels far; beyond they
/// are 0.
///
/// # Errors
/// If `size` is not that of a texture, or sums of texels overflow.
pub fn transfer(
    texture: &Texture,
    from: &[[Vec2; 3]],
    to: &[[Vec2; 3]],
    size: u32,
    gutter: u32,
) -> Result<Texture, SceneError> {
    let channels = texture.channels() as usize;
    // An invalid size is rejected below, but must not exhaust memory before.
    let side = Texture::nearest_side(size) as usize;
    let mut redrawn = vec![0.0; side * side * channels];
    let mut drawn = vec![false; side * side];
    for (from, to) in from.iter().zip(to) {
        texels_in(to, [side; 2], 0..side, |x, y, weights| {
            let [wa, wb, wc] = weights.as_vec3().to_array();
            let uv = wa * from[0] + wb * from[1] + wc * from[2];
            let at = (y * side + x) * channels;
            sample(texture, uv, &mut redrawn[at..at + channels]);
            drawn[y * side + x] = true;
        });
    }
    for _ in 0..gutter {
        dilate(&mut redrawn, &mut drawn, channels, side);
    }
    Texture::new(size, size, texture.channels(), redrawn)
}

/// Bilinear sample, clamped at the border.
fn sample(texture: &Texture, uv: Vec2, out: &mut [f32]) {
    let (width, height) = (texture.width() as usize, texture.height() as usize);
    let last = Vec2::new((width - 1) as f32, (height - 1) as f32);
    let st = (uv * Vec2::new(width as f32, height as f32) - 0.5).clamp(Vec2::ZERO, last);
    let (x, y) = (st.x as usize, st.y as usize);
    let (fx, fy) = (st.x - x as f32, st.y - y as f32);
    let (right, below) = ((x + 1).min(width - 1), (y + 1).min(height - 1));
    let taps = [
        (x, y, (1.0 - fx) * (1.0 - fy)),
        (right, y, fx * (1.0 - fy)),
        (x, below, (1.0 - fx) * fy),
        (right, below, fx * fy),
    ];
    for (k, value) in out.iter_mut().enumerate() {
        *value =
            taps.iter().map(|&(x, y, w)| w * texture.texels()[(y * width + x) * texture.channels() as usize + k]).sum();
    }
}

/// Sets every undrawn texel beside drawn ones to their mean.
fn dilate(texels: &mut [f32], drawn: &mut [bool], channels: usize, side: usize) {
    let mut added: Vec<(usize, Vec<f32>)> = vec![];
    for (i, _) in drawn.iter().enumerate().filter(|d| !d.1) {
        let (x, y) = (i % side, i / side);
        let rows = y.saturating_sub(1)..=(y + 1).min(side - 1);
        let around = rows.flat_map(|j| (x.saturating_sub(1)..=(x + 1).min(side - 1)).map(move |i| j * side + i));
        let (mut sum, mut count) = (vec![0.0; channels], 0.0);
        for n in around.filter(|&n| drawn[n]) {
            sum.iter_mut().zip(&texels[n * channels..(n + 1) * channels]).for_each(|(s, v)| *s += v);
            count += 1.0;
        }
        if count > 0.0 {
            sum.iter_mut().for_each(|s| *s /= count);
            added.push((i, sum));
        }
    }
    for (i, value) in added {
        texels[i * channels..(i + 1) * channels].copy_from_slice(&value);
        drawn[i] = true;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::testing::largest;

    /// Two triangles that cover the square from `low` to `high`.
    fn square(low: Vec2, high: Vec2) -> Vec<[Vec2; 3]> {
        let at = |x: f32, y: f32| low + (high - low) * Vec2::new(x, y);
        vec![[at(0.0, 0.0), at(1.0, 0.0), at(1.0, 1.0)], [at(0.0, 0.0), at(1.0, 1.0), at(0.0, 1.0)]]
    }

    fn ramp() -> Texture {
        let texels = (0..32 * 32).flat_map(|i| [(i % 32) as f32, (i / 32) as f32]).collect();
        Texture::new(32, 32, 2, texels).unwrap()
    }

    #[test]
    fn the_same_layout_gives_the_same_texels() {
        let all = square(Vec2::ZERO, Vec2::ONE);
        let same = transfer(&ramp(), &all, &all, 32, 0).unwrap();
        let error = largest(same.texels().iter().zip(ramp().texels()).map(|(a, b)| f64::from((a - b).abs())));
        assert!(error < 1e-4, "{error}");
    }

    #[test]
    fn content_follows_its_triangles_and_fills_the_gutter() {
        let (from, to) = (square(Vec2::splat(0.25), Vec2::splat(0.75)), square(Vec2::splat(0.5), Vec2::splat(0.75)));
        let moved = transfer(&ramp(), &from, &to, 64, 3).unwrap();
        let at = |x: usize, y: usize| [moved.texels()[2 * (y * 64 + x)], moved.texels()[2 * (y * 64 + x) + 1]];
        // Texel centres 32.5 to 47.5 of 64 map to 8 to 24 of 32: one texel to one.
        for (x, y) in [(32, 32), (40, 33), (47, 47)] {
            let expected = [(x - 24) as f32, (y - 24) as f32];
            assert!(at(x, y).iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-3), "{x} {y}: {:?}", at(x, y));
        }
        assert!(at(29, 40)[0] > 7.0, "three texels of gutter: {:?}", at(29, 40));
        assert_eq!(at(28, 40), [0.0; 2], "and no more");
        assert!(transfer(&ramp(), &from, &[[Vec2::NAN; 3], [Vec2::ONE; 3]], 64, 1).is_ok());
        assert!(transfer(&ramp(), &from, &to, 0, 0).is_err());
    }
}
