use crate::scene::{Atlas, HybridScene, Mesh, SceneError, SplatArrays, Splats, Texture, sh};

/// Converts splats to another SH degree, at most 3: drops the higher bands or adds zeros.
#[must_use]
pub fn with_sh_degree(splats: Splats, degree: u32) -> Splats {
    let degree = degree.min(sh::MAX_DEGREE);
    if degree == splats.sh_degree() {
        return splats;
    }
    let arrays = splats.into_arrays().with_sh_degree(degree);
    arrays.check().expect("a lower degree is a part, and zeros are valid")
}

/// Limits the SH degree of a mesh's colour to `degree`.
#[must_use]
pub fn with_mesh_sh_degree(mesh: Mesh, degree: u32) -> Mesh {
    let atlas = mesh.atlas();
    let Some(bands) = atlas.bands().filter(|_| atlas.sh_degree() > degree) else { return mesh };
    let channels = sh::band_floats(degree);
    let kept = (channels > 0).then(|| {
        let rows = bands.texels().chunks_exact(bands.channels() as usize);
        let texels = rows.flat_map(|texel| texel[..channels].iter().copied()).collect();
        Texture::new(bands.width(), bands.height(), channels as u32, texels).expect("part of a texture is a texture")
    });
    let atlas = Atlas::new(atlas.base().clone(), kept).expect("the bands of a lower degree are bands");
    mesh.with_atlas(atlas)
}

/// Joins scenes into one: all splats in sequence, at the highest SH degree among the scenes, and all meshes. The flag
/// of each scene says whether its file states how it is blended (`format::SceneFile::states_composition`).
///
/// The composition is that of the first scene that states one and has a mesh; else of the first that states one; else
/// of the first with a mesh; else of the first. Exceptions: the number of layers is the largest among scenes with
/// meshes, the pixel filter is that of the first scene with splats, and the near plane is the nearest among scenes that
/// state their composition, or among all if none does.
///
/// # Errors
/// If the scenes blend in different colour spaces: one scene's colours would be wrong in the other's.
pub fn join(scenes: Vec<(HybridScene, bool)>) -> Result<HybridScene, SceneError> {
    let degree = scenes.iter().map(|(s, _)| s.splats.sh_degree()).max().unwrap_or(0);
    let has_mesh = |s: &HybridScene| !s.meshes.is_empty();
    let states_any = scenes.iter().any(|(_, states)| *states);
    // Reversed, because `max_by_key` returns the last of equal elements.
    let rule = scenes.iter().rev().max_by_key(|(s, states)| (*states, has_mesh(s)));
    let mut composition = rule.map(|(s, _)| s.composition).unwrap_or_default();
    if let Some((with_splats, _)) = scenes.iter().find(|(s, _)| !s.splats.is_empty()) {
        composition.pixel_filter = with_splats.composition.pixel_filter;
    }
    let with_mesh = scenes.iter().filter(|(s, _)| has_mesh(s));
    composition.layers = with_mesh.map(|(s, _)| s.composition.layers).fold(composition.layers, u32::max);
    // Scenes that state no composition have the default near plane, in whatever unit.
    let with_near = scenes.iter().filter(|(_, states)| *states || !states_any);
    composition.near = with_near.map(|(s, _)| s.composition.near).fold(composition.near, f32::min);
    let mut all = SplatArrays { sh_degree: degree, ..SplatArrays::default() };
    let mut meshes = vec![];
    for (i, (scene, _)) in scenes.into_iter().enumerate() {
        let (expected, found) = (composition.color_space, scene.composition.color_space);
        if found != expected {
            let field = format!("scene {} of those to be joined", i + 1);
            return Err(SceneError::new(field, format!("colours in {expected:?}"), format!("{found:?}")));
        }
        all.append(scene.splats.into_arrays().with_sh_degree(degree));
        meshes.extend(scene.meshes);
    }
    Ok(HybridScene { splats: all.check()?, meshes, composition })
}
