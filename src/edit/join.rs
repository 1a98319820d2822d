use crate::scene::{Atlas, HybridScene, Mesh, SceneError, SplatArrays, Splats, Texture, sh};

/// The splats of these indices, in their order. An index may come more than once. A selection in ascending order, or
/// another order of all, takes no memory besides.
///
/// # Panics
/// If an index is out of range.
#[must_use]
pub fn gather(splats: Splats, indices: &[usize]) -> Splats {
    let order = Order::of(indices, splats.len());
    let mut s = splats.into_arrays();
    order.apply(&mut s.means, 1);
    order.apply(&mut s.rotations, 1);
    order.apply(&mut s.log_scales, 1);
    order.apply(&mut s.opacity_logits, 1);
    order.apply(&mut s.sh, sh::coefficients(s.sh_degree));
    s.check().expect("copies of valid splats are valid")
}

/// Indices, and what they allow to do in place.
enum Order<'a> {
    Ascending(&'a [usize]),
    Permutation(&'a [usize]),
    Any(&'a [usize]),
}

impl<'a> Order<'a> {
    fn of(indices: &'a [usize], count: usize) -> Self {
        if indices.is_sorted_by(|a, b| a < b) {
            return Self::Ascending(indices);
        }
        let mut seen = vec![false; count];
        let once = indices.iter().all(|&i| !std::mem::replace(&mut seen[i], true));
        if once && indices.len() == count { Self::Permutation(indices) } else { Self::Any(indices) }
    }

    /// Leaves the rows of these indices, of `width` elements each.
    fn apply<T: Copy>(&self, rows: &mut Vec<T>, width: usize) {
        let row = |i: usize| i * width..(i + 1) * width;
        match *self {
            Self::Ascending(indices) => {
                indices.iter().enumerate().for_each(|(to, &from)| rows.copy_within(row(from), to * width));
                rows.truncate(indices.len() * width);
                rows.shrink_to_fit();
            }
            Self::Permutation(indices) => {
                let mut placed = vec![false; indices.len()];
                for start in 0..indices.len() {
                    if placed[start] {
                        continue;
                    }
                    // Round the cycle: each row makes room for the one that is to come there.
                    let first = rows[row(start)].to_vec();
                    let mut to = start;
                    while indices[to] != start {
                        rows.copy_within(row(indices[to]), to * width);
                        placed[to] = true;
                        to = indices[to];
                    }
                    rows[row(to)].copy_from_slice(&first);
                    placed[to] = true;
                }
            }
            Self::Any(indices) => *rows = indices.iter().flat_map(|&i| &rows[row(i)]).copied().collect(),
        }
    }
}

/// Splats of another SH degree, at most 3: higher bands are dropped, or added as zeros.
#[must_use]
pub fn with_sh_degree(splats: Splats, degree: u32) -> Splats {
    let degree = degree.min(sh::MAX_DEGREE);
    if degree == splats.sh_degree() {
        return splats;
    }
    let mut s = splats.into_arrays();
    let [before, after] = [s.sh_degree, degree].map(sh::coefficients);
    if after < before {
        (0..s.means.len()).for_each(|i| s.sh.copy_within(i * before..i * before + after, i * after));
        s.sh.truncate(s.means.len() * after);
        s.sh.shrink_to_fit();
    } else {
        let mut wider = vec![[0.0; 3]; s.means.len() * after];
        let rows = wider.chunks_exact_mut(after).zip(s.sh.chunks_exact(before));
        rows.for_each(|(to, from)| to[..before].copy_from_slice(from));
        s.sh = wider;
    }
    s.sh_degree = degree;
    s.check().expect("a lower degree is a part, and zeros are valid")
}

/// A mesh whose colour has at most this SH degree.
#[must_use]
pub fn with_mesh_sh_degree(mesh: Mesh, degree: u32) -> Mesh {
    let atlas = mesh.atlas();
    let Some(bands) = atlas.bands().filter(|_| atlas.sh_degree() > degree) else { return mesh };
    let channels = 3 * (sh::coefficients(degree) - 1);
    let kept = (channels > 0).then(|| {
        let rows = bands.texels().chunks_exact(bands.channels() as usize);
        let texels = rows.flat_map(|texel| texel[..channels].iter().copied()).collect();
        Texture::new(bands.width(), bands.height(), channels as u32, texels).expect("part of a texture is a texture")
    });
    let atlas = Atlas::new(atlas.base().clone(), kept).expect("the bands of a lower degree are bands");
    mesh.with_atlas(atlas)
}

/// All scenes as one: splats one after the other, at the highest SH degree among them, and all meshes. It is blended by
/// the rule of the first scene with a mesh, else of the first.
///
/// # Errors
/// If the scenes blend in different colour spaces: colours of one would be wrong in the other.
pub fn join(scenes: Vec<HybridScene>) -> Result<HybridScene, SceneError> {
    let degree = scenes.iter().map(|s| s.splats.sh_degree()).max().unwrap_or(0);
    let rule = scenes.iter().find(|s| !s.meshes.is_empty()).or(scenes.first());
    let composition = rule.map(|s| s.composition).unwrap_or_default();
    let mut all = SplatArrays { sh_degree: degree, ..SplatArrays::default() };
    let mut meshes = vec![];
    for (i, scene) in scenes.into_iter().enumerate() {
        let (expected, found) = (composition.color_space, scene.composition.color_space);
        if found != expected {
            let field = format!("scene {} of those to be joined", i + 1);
            return Err(SceneError::new(field, format!("colours in {expected:?}"), format!("{found:?}")));
        }
        all.append(with_sh_degree(scene.splats, degree).into_arrays());
        meshes.extend(scene.meshes);
    }
    Ok(HybridScene { splats: all.check()?, meshes, composition })
}
