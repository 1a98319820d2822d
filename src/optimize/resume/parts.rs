//! Parts of a run in the arrays of a checkpoint: what each `put_…` stores, the matching `take_…` takes out again, or
//! says what is wrong with it.

use glam::{Vec2, Vec3};
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

use crate::{
    optimize::{checkpoint::Checkpoint, density::mcmc::EpochWeight},
    render::gpu::{per_view::PerView, vertices::VertexState},
    scene::{Atlas, Mesh, SceneError, Texture},
};

/// The part taken out, or an error message.
pub(super) type Taken<T> = Result<T, String>;

pub(super) fn damaged(what: &str) -> String {
    format!("{what} is missing or damaged")
}

/// A field of the checkpoint's metadata.
pub(super) fn field<T: DeserializeOwned>(file: &Checkpoint, name: &str) -> Taken<T> {
    let value = file.meta.get(name).and_then(|value| T::deserialize(value).ok());
    value.ok_or_else(|| damaged(name))
}

pub(super) fn put_floats(name: &str, values: Vec<f32>, file: &mut Checkpoint) {
    file.tensors.insert(name.to_owned(), values);
}

pub(super) fn take_floats(name: &str, file: &mut Checkpoint) -> Taken<Vec<f32>> {
    file.tensors.remove(name).ok_or_else(|| damaged(name))
}

pub(super) fn put_words(name: &str, values: Vec<u32>, file: &mut Checkpoint) {
    file.indices.insert(name.to_owned(), values);
}

pub(super) fn take_words(name: &str, file: &mut Checkpoint) -> Taken<Vec<u32>> {
    file.indices.remove(name).ok_or_else(|| damaged(name))
}

pub(super) fn put_meshes(meshes: &[Mesh], file: &mut Checkpoint) {
    let mut sizes = vec![];
    for (i, mesh) in meshes.iter().enumerate() {
        let (atlas, name) = (mesh.atlas(), |part: &str| format!("mesh{i}/{part}"));
        put_floats(&name("positions"), bytemuck::cast_slice(mesh.positions()).to_vec(), file);
        put_floats(&name("corner_uvs"), bytemuck::cast_slice(mesh.corner_uvs()).to_vec(), file);
        put_floats(&name("base"), atlas.base().texels().to_vec(), file);
        put_floats(&name("bands"), atlas.bands().map_or(vec![], |b| b.texels().to_vec()), file);
        put_words(&name("triangles"), mesh.triangles().as_flattened().to_vec(), file);
        let size = |t: &Texture| json!([t.width(), t.height(), t.channels()]);
        sizes.push(json!({ "base": size(atlas.base()), "bands": atlas.bands().map(size) }));
    }
    file.meta["meshes"] = sizes.into();
}

pub(super) fn take_meshes(file: &mut Checkpoint) -> Taken<Vec<Mesh>> {
    let sizes: Vec<Value> = field(file, "meshes")?;
    sizes.iter().enumerate().map(|(i, sizes)| take_mesh(i, sizes, file)).collect()
}

fn take_mesh(i: usize, sizes: &Value, file: &mut Checkpoint) -> Taken<Mesh> {
    let name = |part: &str| format!("mesh{i}/{part}");
    let invalid = |e: SceneError| e.to_string();
    let positions = take_floats(&name("positions"), file)?;
    let uvs = take_floats(&name("corner_uvs"), file)?;
    let triangles = take_words(&name("triangles"), file)?;
    let mut texture = |part: &str| -> Taken<Option<Texture>> {
        let texels = take_floats(&name(part), file)?;
        let Some(size) = sizes.get(part).filter(|s| !s.is_null()) else { return Ok(None) };
        let [w, h, c]: [u32; 3] = serde_json::from_value(size.clone()).map_err(|_| damaged(part))?;
        Ok(Some(Texture::new(w, h, c, texels).map_err(invalid)?))
    };
    let base = texture("base")?.ok_or_else(|| damaged("base"))?;
    let bands = texture("bands")?;
    let positions = rows("positions", &positions)?.iter().copied().map(Vec3::from_array).collect();
    let triangles = rows("triangles", &triangles)?.to_vec();
    let uvs = rows::<_, 6>("corner_uvs", &uvs)?.iter().map(|c| [0, 2, 4].map(|k| Vec2::new(c[k], c[k + 1]))).collect();
    Mesh::new(positions, triangles, uvs, Atlas::new(base, bands).map_err(invalid)?).map_err(invalid)
}

/// Values as rows of `N`; an error if some are left over.
fn rows<'a, T, const N: usize>(name: &str, values: &'a [T]) -> Taken<&'a [[T; N]]> {
    let (rows, rest) = values.as_chunks();
    if rest.is_empty() { Ok(rows) } else { Err(damaged(name)) }
}

pub(super) fn put_vertices(vertices: VertexState, file: &mut Checkpoint) {
    put_floats("vertices/pixel", vec![vertices.pixel], file);
    put_floats("vertices/normals", vertices.normals, file);
    put_floats("vertices/moments", vertices.moments, file);
}

pub(super) fn take_vertices(file: &mut Checkpoint) -> Taken<VertexState> {
    let pixel = take_floats("vertices/pixel", file)?;
    Ok(VertexState {
        pixel: pixel.first().copied().ok_or_else(|| damaged("vertices/pixel"))?,
        normals: take_floats("vertices/normals", file)?,
        moments: take_floats("vertices/moments", file)?,
    })
}

pub(super) fn put_epoch(epoch: EpochWeight, file: &mut Checkpoint) {
    put_floats("epoch_weight", epoch.weight, file);
    file.meta["epoch_iterations"] = epoch.iterations.into();
}

pub(super) fn take_epoch(file: &mut Checkpoint) -> Taken<EpochWeight> {
    Ok(EpochWeight { weight: take_floats("epoch_weight", file)?, iterations: field(file, "epoch_iterations")? })
}

/// Stores per-view values and their moments under the name `what`.
pub(super) fn put_views<const N: usize>(what: &str, of: PerView<N>, file: &mut Checkpoint) {
    let [first, second] = of.moments;
    for (part, floats) in [("values", of.values), ("m", first), ("v", second)] {
        put_floats(&format!("{what}/{part}"), floats, file);
    }
    put_words(&format!("{what}/steps"), of.steps, file);
}

/// Takes out the values of [`put_views`], if they are complete for this many views.
pub(super) fn take_views<const N: usize>(what: &str, views: usize, file: &mut Checkpoint) -> Taken<PerView<N>> {
    let mut take = |part: &str| take_floats(&format!("{what}/{part}"), file);
    let whole = (take("values"), take("m"), take("v"), take_words(&format!("{what}/steps"), file));
    let (Ok(values), Ok(first), Ok(second), Ok(steps)) = whole else { return Err(damaged(what)) };
    let of = PerView { values, moments: [first, second], steps };
    if of.is_of(views) { Ok(of) } else { Err(damaged(what)) }
}
