use crate::scene::{Atlas, HybridScene, Mesh, SceneError, SplatArrays, Splats, Texture, sh};

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
/// the rule of the first scene with a mesh, else of the first, from the nearest near plane among them on.
///
/// # Errors
/// If the scenes blend in different colour spaces: colours of one would be wrong in the other.
pub fn join(scenes: Vec<HybridScene>) -> Result<HybridScene, SceneError> {
    let degree = scenes.iter().map(|s| s.splats.sh_degree()).max().unwrap_or(0);
    let rule = scenes.iter().find(|s| !s.meshes.is_empty()).or(scenes.first());
    let mut composition = rule.map(|s| s.composition).unwrap_or_default();
    composition.near = scenes.iter().map(|s| s.composition.near).fold(composition.near, f32::min);
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
