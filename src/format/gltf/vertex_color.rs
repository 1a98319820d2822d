//! Conversion of vertex colours, which a scene's meshes do not have, to a map on which every triangle has its own
//! texels.

use glam::Vec2;

use super::lift::Asset;
use super::triangles::Stored;
use crate::format::error::Fault;
use crate::scene::Texture;

/// `COLOR_0` of the kept vertices in linear light; `None` if there is none.
pub(super) fn read(
    asset: &Asset,
    id: (usize, usize),
    Stored { count, kept }: &Stored,
) -> Result<Option<Vec<[f32; 4]>>, Fault> {
    let Some(&accessor) = asset.attributes.get(&id).and_then(|a| a.get("COLOR_0")) else { return Ok(None) };
    let has_alpha = asset.document.accessors().nth(accessor).is_some_and(|a| a.dimensions().multiplicity() == 4);
    let colors: Vec<[f32; 4]> = if has_alpha {
        asset.floats::<4>(accessor)?
    } else {
        asset.floats::<3>(accessor)?.into_iter().map(|[r, g, b]| [r, g, b, 1.0]).collect()
    };
    if colors.len() != *count {
        let at = format!("/meshes/{}/primitives/{}/attributes/COLOR_0", id.0, id.1);
        return Err(Fault::pointer(at, format!("{count} elements, as in POSITION"), colors.len().to_string()));
    }
    Ok(Some(match kept {
        Some(kept) => kept.iter().map(|&vertex| colors[vertex]).collect(),
        None => colors,
    }))
}

/// Map that interpolates `texels` at vertices linearly within triangles, and the triangles' corners on it.
///
/// Each triangle has 2×2 texels, three of which are its corners. With the fourth as the sum of its two neighbours minus
/// the opposite corner, bilinear filtering is linear. Odd sides keep the map free of mip levels, which would mix
/// triangles.
pub(super) fn atlas(texels: &[[f32; 4]], triangles: &[[u32; 3]]) -> Result<(Texture, Vec<[Vec2; 3]>), Fault> {
    let columns = (triangles.len() as f64).sqrt().ceil().max(1.0) as usize;
    let (width, height) = (2 * columns + 1, 2 * triangles.len().div_ceil(columns) + 1);
    if width > Texture::MAX_SIDE as usize {
        return Err(Fault::whole("at most 67 million triangles with colours of vertices", triangles.len().to_string()));
    }
    // Unused texels get the value of a corner, so that the map of opaque triangles is opaque everywhere.
    let rest = triangles.first().map_or([0.0; 4], |triangle| texels[triangle[0] as usize]);
    let mut map = vec![rest; width * height];
    let size = Vec2::new(width as f32, height as f32);
    let mut corners = Vec::with_capacity(triangles.len());
    for (i, triangle) in triangles.iter().enumerate() {
        let (x, y) = (2 * (i % columns), 2 * (i / columns));
        let [a, b, c] = triangle.map(|v| texels[v as usize]);
        map[y * width + x] = a;
        map[y * width + x + 1] = b;
        map[(y + 1) * width + x] = c;
        map[(y + 1) * width + x + 1] = std::array::from_fn(|k| b[k] + c[k] - a[k]);
        let at = |dx: usize, dy: usize| (Vec2::new((x + dx) as f32, (y + dy) as f32) + 0.5) / size;
        corners.push([at(0, 0), at(1, 0), at(0, 1)]);
    }
    Ok((Texture::new(width as u32, height as u32, 4, map.into_flattened())?, corners))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_are_linear_within_every_triangle() {
        let texels: Vec<[f32; 4]> = (0..7).map(|i| std::array::from_fn(|k| ((i * 5 + k * 3) % 7) as f32)).collect();
        let triangles = [[0, 1, 2], [2, 1, 3], [4, 5, 6], [6, 0, 3], [5, 2, 1]];
        let (map, corners) = atlas(&texels, &triangles).unwrap();
        assert_eq!(map.mip_levels(), 1);
        let sample = |uv: Vec2| -> [f32; 4] {
            let p = uv * Vec2::new(map.width() as f32, map.height() as f32) - 0.5;
            let (low, f) = (p.floor(), p - p.floor());
            let texel = |dx: u32, dy: u32, k: usize| {
                let i =
                    (low.y as u32 + dy).min(map.height() - 1) * map.width() + (low.x as u32 + dx).min(map.width() - 1);
                map.texels()[i as usize * 4 + k]
            };
            std::array::from_fn(|k| {
                let row = |dy| texel(0, dy, k) * (1.0 - f.x) + texel(1, dy, k) * f.x;
                row(0) * (1.0 - f.y) + row(1) * f.y
            })
        };
        for (triangle, uvs) in triangles.iter().zip(&corners) {
            for weights in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.2, 0.3, 0.5], [0.0, 0.5, 0.5]] {
                let uv = uvs.iter().zip(weights).map(|(uv, w)| *uv * w).sum::<Vec2>();
                let found = sample(uv);
                for k in 0..4 {
                    let expected: f32 = triangle.iter().zip(weights).map(|(&v, w)| texels[v as usize][k] * w).sum();
                    assert!((found[k] - expected).abs() < 1e-4, "{found:?} {expected}");
                }
            }
        }
    }
}
