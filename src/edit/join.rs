use crate::scene::{Atlas, HybridScene, Mesh, SceneError, SplatArrays, Splats, Texture, sh};

/// The splats of these indices, in their order. An index may come more than once.
///
/// # Panics
/// If an index is out of range.
#[must_use]
pub fn gather(splats: &Splats, indices: &[usize]) -> Splats {
    let k = sh::coefficients(splats.sh_degree());
    let mut sh = Vec::with_capacity(indices.len() * k);
    indices.iter().for_each(|&i| sh.extend_from_slice(splats.sh_of(i)));
    SplatArrays {
        means: indices.iter().map(|&i| splats.means()[i]).collect(),
        rotations: indices.iter().map(|&i| splats.rotations()[i]).collect(),
        log_scales: indices.iter().map(|&i| splats.log_scales()[i]).collect(),
        opacity_logits: indices.iter().map(|&i| splats.opacity_logits()[i]).collect(),
        sh_degree: splats.sh_degree(),
        sh,
    }
    .check()
    .expect("copies of valid splats are valid")
}

/// Splats of another SH degree, at most 3: higher bands are dropped, or added as zeros.
#[must_use]
pub fn with_sh_degree(splats: Splats, degree: u32) -> Splats {
    let degree = degree.min(sh::MAX_DEGREE);
    if degree == splats.sh_degree() {
        return splats;
    }
    let mut s = splats.into_arrays();
    let rows = s.sh.chunks_exact(sh::coefficients(s.sh_degree));
    let padded = rows.flat_map(|c| c.iter().copied().chain(std::iter::repeat([0.0; 3])).take(sh::coefficients(degree)));
    s.sh = padded.collect();
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
        let mut s = with_sh_degree(scene.splats, degree).into_arrays();
        all.means.append(&mut s.means);
        all.rotations.append(&mut s.rotations);
        all.log_scales.append(&mut s.log_scales);
        all.opacity_logits.append(&mut s.opacity_logits);
        all.sh.append(&mut s.sh);
        meshes.extend(scene.meshes);
    }
    Ok(HybridScene { splats: all.check()?, meshes, composition })
}
