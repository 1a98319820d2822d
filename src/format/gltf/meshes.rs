//! Conversion of triangle primitives to meshes of a scene. Primitives with the same material become one mesh and share
//! its maps, except animated ones.

use std::collections::hash_map::Entry;
use std::collections::{HashMap, HashSet};

use glam::{DMat3, DMat4, Vec2, Vec3};
use gltf::material::AlphaMode;
use gltf::mesh::Mode;

use super::binding::{Bindable, wanted};
use super::extension::{HYBRID, Surface};
use super::instancing::BYTES_OF_COPY;
use super::lift::Asset;
use super::material::{self, BaseColour, Made, Maps};
use super::motion::Motion;
use super::pose::Poses;
use super::transform::frame_of;
use super::triangles::{self, Triangles};
use super::uv::Unrolling;
use super::vertex_color;
use crate::format::activation;
use crate::format::error::{Fault, from_value};
use crate::format::map_budget::MapBudget;
use crate::format::placed::{orthogonal, turned};
use crate::scene::rig::RestSurface;
use crate::scene::{Atlas, ColorSpace, Mesh, SceneError, Texture};

/// Bytes of a mesh besides its arrays.
const BYTES_OF_MESH: u64 = 1024;

/// Upper bound on floats of maps multiplied by vertex colours, 1 GiB in total.
const MAX_TINTED_FLOATS: u64 = 1 << 28;

/// Meshes under construction.
pub(super) struct Meshes<'a> {
    asset: &'a Asset,
    motion: &'a Motion,
    poses: Poses,
    /// Primitives at nodes to which splats are bound; `bindable` has their content.
    wanted: HashSet<(usize, usize)>,
    /// Accessors used as positions by several primitives, each of which uses a part.
    common: HashSet<usize>,
    bindable: HashMap<(usize, usize), Bindable>,
    space: ColorSpace,
    stated_layers: Option<u32>,
    /// Transform from glTF's frame to the scene's.
    frame: DMat4,
    maps: HashMap<Option<usize>, Maps>,
    /// Those of them that are single-sided in the file.
    single_sided: HashSet<Option<usize>>,
    /// Maps of textured materials multiplied by a colour; `tinted_floats`: their number of floats.
    tinted: HashMap<(Option<usize>, Tint), Atlas>,
    tinted_floats: u64,
    budget: MapBudget,
    made: Made,
    groups: Vec<Group>,
    /// Index of the group for a material and a colour, for primitives that may share it.
    shared: HashMap<(Option<usize>, Option<Tint>), usize>,
}

/// Bits of a colour common to all vertices.
type Tint = [u32; 4];

#[derive(Default)]
struct Group {
    positions: Vec<Vec3>,
    triangles: Vec<[u32; 3]>,
    corner_uvs: Vec<[Vec2; 3]>,
    material: Option<usize>,
    /// Colour by which the material's maps are multiplied.
    tint: Option<Tint>,
    /// Atlas used instead of the material's.
    atlas: Option<Atlas>,
    /// Rotation of view dependence with the surface, if the material's maps are view-dependent.
    turn: Option<DMat3>,
    /// Whether the transform above view-dependent maps is flat, so that the surface is not drawn.
    is_flat: bool,
    /// Surface before posing, if it is animated.
    rest_surface: Option<RestSurface>,
}

/// All meshes and their animation.
pub(super) struct Finished {
    pub(super) meshes: Vec<Mesh>,
    /// Rest surface per mesh; `None` for static meshes.
    pub(super) rest_surfaces: Vec<Option<RestSurface>>,
    pub(super) poses: Poses,
    /// Primitives to which splats are bound, by (node, primitive).
    pub(super) bindable: HashMap<(usize, usize), Bindable>,
}

impl<'a> Meshes<'a> {
    /// Creates an empty collection; `stated_layers`: the number of mesh layers per pixel that the scene states.
    pub(super) fn new(
        asset: &'a Asset,
        motion: &'a Motion,
        space: ColorSpace,
        stated_layers: Option<u32>,
    ) -> Result<Self, Fault> {
        let poses = Poses::new(&asset.document, motion)?;
        Ok(Self {
            asset,
            motion,
            poses,
            wanted: wanted(asset),
            common: common_positions(&asset.document),
            bindable: HashMap::new(),
            space,
            stated_layers,
            frame: frame_of(&asset.document),
            maps: HashMap::new(),
            single_sided: HashSet::new(),
            tinted: HashMap::new(),
            tinted_floats: 0,
            budget: MapBudget::new(asset.buffer_bytes() as u64),
            made: Made::new(),
            groups: vec![],
            shared: HashMap::new(),
        })
    }

    /// As [`Poses::moves`].
    pub(super) fn moves(&self, node: usize) -> bool {
        self.poses.moves(node)
    }

    /// Adds a primitive, or its instances `copies` if there are any; false if its mode has no triangles.
    pub(super) fn add(
        &mut self,
        (node, transform): (&gltf::Node<'_>, DMat4),
        copies: Option<&[DMat4]>,
        primitive: &gltf::Primitive<'_>,
        notes: &mut Vec<String>,
    ) -> Result<bool, Fault> {
        let at = format!("/nodes/{}", node.index());
        let uv_set = self.maps_of(&primitive.material(), notes)?.uv.set;
        let poses = &mut self.poses;
        let read = triangles::read((self.asset, self.motion), poses, (node, transform), primitive, uv_set, notes)?;
        let Some(mut geometry) = read else { return Ok(false) };
        if geometry.triangles.is_empty() {
            notes.push(format!("{at}: a mesh without triangles is left out"));
            return Ok(true);
        }
        let has_own_order = primitive.extension_value(HYBRID).is_some();
        if !has_own_order && positions_of(primitive).is_some_and(|accessor| self.common.contains(&accessor)) {
            // The whole accessor has been read for the part that the primitive uses.
            self.asset.spend(geometry.positions.len() as u64 * 12, &at)?;
            geometry = geometry.of_used_vertices();
        }
        check_positions(&geometry, node, primitive)?;
        let Some(copies) = copies else {
            self.take((node, transform), primitive, geometry, notes)?;
            return Ok(true);
        };
        let turns = self.maps[&primitive.material().index()].atlas.sh_degree() > 0;
        if !(turns || has_own_order || self.poses.animates(&geometry.rest_surface, self.motion)) {
            let look = self.look((node, transform), primitive, &geometry, notes)?;
            self.take_copies((node, transform), copies, &geometry, look)?;
            return Ok(true);
        }
        // Every instance would give the same notes.
        let mut said = vec![];
        for (i, local) in copies.iter().enumerate() {
            self.asset.spend(BYTES_OF_COPY, &at)?;
            let copy = geometry.copy(&mut self.poses, (node, transform), *local);
            let notes = if i == 0 { &mut *notes } else { &mut said };
            self.take((node, transform * *local), primitive, copy, notes)?;
            said.clear();
        }
        Ok(true)
    }

    /// Adds instances of a primitive's triangles, which are static and not view-dependent, as one surface.
    fn take_copies(
        &mut self,
        (node, transform): (&gltf::Node<'_>, DMat4),
        copies: &[DMat4],
        geometry: &Triangles,
        mut look: Group,
    ) -> Result<(), Fault> {
        let at = format!("/nodes/{}", node.index());
        let corner_uvs = std::mem::take(&mut look.corner_uvs);
        let bytes = BYTES_OF_COPY + geometry.positions.len() as u64 * 12 + geometry.triangles.len() as u64 * 36;
        self.asset.spend(look.atlas.as_ref().map_or(0, |atlas| atlas.floats() as u64 * 4 + BYTES_OF_MESH), &at)?;
        for local in copies {
            self.asset.spend(bytes, &at)?;
            let copy = geometry.copy(&mut self.poses, (node, transform), *local);
            let too_many = || Fault::pointer(&at, "fewer than 2³² vertices of all copies", "more");
            let first = u32::try_from(look.positions.len()).map_err(|_| too_many())?;
            first.checked_add(copy.positions.len() as u32).ok_or_else(too_many)?;
            look.positions.extend(copy.positions);
            look.triangles.extend(copy.triangles.iter().map(|t| t.map(|v| v + first)));
            let is_turned_over = copy.is_mirrored != geometry.is_mirrored;
            let uvs = corner_uvs.iter().map(|&[a, b, c]| if is_turned_over { [a, c, b] } else { [a, b, c] });
            look.corner_uvs.extend(uvs);
        }
        if !look.triangles.is_empty() {
            self.join(look).map_err(|fault| fault.under(&at))?;
        }
        Ok(())
    }

    /// Adds the triangles of a primitive with this transform.
    fn take(
        &mut self,
        (node, transform): (&gltf::Node<'_>, DMat4),
        primitive: &gltf::Primitive<'_>,
        mut geometry: Triangles,
        notes: &mut Vec<String>,
    ) -> Result<(), Fault> {
        let at = format!("/nodes/{}", node.index());
        let look = self.look((node, transform), primitive, &geometry, notes)?;
        if look.is_flat {
            // As `Rig::pose` does: where the node moves, other poses may show it.
            geometry.positions.fill(transform.w_axis.truncate().as_vec3());
        }
        let moves = self.poses.animates(&geometry.rest_surface, self.motion);
        let id = (node.index(), primitive.index());
        let is_bindable = self.wanted.contains(&id) && primitive.mode() == Mode::Triangles;
        let undeformed = is_bindable.then(|| undeformed(&geometry));
        if let Some(source) = surface_vertices(self.asset, node, primitive, &geometry.positions)? {
            join_copies(&mut geometry, &source, moves);
        }
        let Triangles { positions, triangles, rest_surface, is_mirrored, .. } = geometry;
        let own_atlas = look.atlas.as_ref().or(look.turn.map(|_| &self.maps[&look.material].atlas));
        let is_alone = moves || own_atlas.is_some();
        let bytes = positions.len() as u64 * 12
            + triangles.len() as u64 * 36
            + own_atlas.map_or(0, |a| a.floats() as u64 * 4)
            + if moves { rest_surface.bytes() } else { 0 }
            + if is_alone { BYTES_OF_MESH } else { 0 };
        self.asset.spend(bytes, &at)?;
        let corners = undeformed.is_some().then(|| triangles.clone());
        let group = Group { positions, triangles, rest_surface: moves.then_some(rest_surface), ..look };
        let (surface, first) = self.join(group).map_err(|fault| fault.under(&at))?;
        if let (Some(stored), Some(corners)) = (undeformed, corners) {
            let unmirrored = |[a, b, c]: [u32; 3]| if is_mirrored { [a, c, b] } else { [a, b, c] };
            let corners = corners.into_iter().map(|t| unmirrored(t).map(|v| v + first)).collect();
            self.bindable.insert(id, Bindable { surface, moves, corners, stored });
        }
        Ok(())
    }

    /// Maps of a material, read on first use.
    fn maps_of(&mut self, material: &gltf::Material<'_>, notes: &mut Vec<String>) -> Result<&Maps, Fault> {
        let index = material.index();
        if !self.maps.contains_key(&index) {
            let maps = material::maps(self.asset, material, self.space, (&mut self.budget, &mut self.made), notes)?;
            let name = index.map_or(String::new(), |i| format!("/materials/{i}: "));
            if !material.double_sided() {
                self.single_sided.insert(index);
            }
            if material.alpha_mode() == AlphaMode::Mask && self.stated_layers == Some(1) && has_holes(&maps.atlas) {
                notes.push(format!(
                    "{name}areas that its alpha mask cuts out use up the single layer stated: surfaces behind them may be missing"
                ));
            }
            self.maps.insert(index, maps);
        }
        Ok(&self.maps[&index])
    }

    /// Group without geometry: the appearance that a material gives to the triangles of a primitive.
    fn look(
        &mut self,
        (node, transform): (&gltf::Node<'_>, DMat4),
        primitive: &gltf::Primitive<'_>,
        Triangles { triangles, uvs, stored, .. }: &Triangles,
        notes: &mut Vec<String>,
    ) -> Result<Group, Fault> {
        let at = format!("/nodes/{}", node.index());
        let material = primitive.material().index();
        let maps = &self.maps[&material];
        let corner_uvs = match uvs {
            Some(uvs) => triangles.iter().map(|t| maps.uv.corners(t.map(|v| uvs[v as usize]))).collect(),
            None => vec![[Vec2::splat(0.5); 3]; triangles.len()],
        };
        let mut group = Group { material, corner_uvs, ..Group::default() };
        if let Some(base) = &maps.base {
            let id = (node.mesh().map_or(0, |m| m.index()), primitive.index());
            let colors = vertex_color::read(self.asset, id, stored)?.unwrap_or_default();
            match one_colour(&colors, triangles) {
                Some(colour) if colour == [1.0; 4] => {}
                Some(colour) if base.is_textured => {
                    let tint = colour.map(f32::to_bits);
                    if let Entry::Vacant(entry) = self.tinted.entry((material, tint)) {
                        let floats = maps.atlas.floats() as u64;
                        if self.tinted_floats + floats > MAX_TINTED_FLOATS {
                            notes.push(format!(
                                "{at}: the vertex colour of a textured mesh is left out, because there are too many different ones"
                            ));
                            return Ok(group);
                        }
                        self.tinted_floats += floats;
                        let shown = (self.space, colour);
                        let counted = (&mut self.budget, &mut self.made);
                        entry.insert(material::tinted(self.asset, &primitive.material(), shown, counted)?);
                    }
                    group.tint = Some(tint);
                }
                Some(colour) => group.atlas = Some(plain(base, colour).map_err(|e| Fault::from(e).under(&at))?),
                None if colors.is_empty() => {}
                None if base.is_textured => {
                    notes.push(format!(
                        "{at}: vertex colours of a textured mesh are left out, because they are not all equal"
                    ));
                }
                None => {
                    if uvs.is_some() {
                        notes.push(format!(
                            "{at}: texture coordinates are replaced by those of the map of its vertex colours"
                        ));
                    }
                    let texels: Vec<[f32; 4]> = colors.iter().map(|c| base.texel(*c)).collect();
                    let (texture, uvs) = vertex_color::atlas(&texels, triangles).map_err(|fault| fault.under(&at))?;
                    group.corner_uvs = uvs;
                    group.atlas = Some(Atlas::new(texture, None).map_err(|e| Fault::from(e).under(&at))?);
                }
            }
        }
        let says_nothing = maps.atlas.floats() == 4 || group.atlas.is_some();
        if uvs.is_none() && !says_nothing {
            notes
                .push(format!("{at}: a mesh without texture coordinates takes its colour from the centre of its maps"));
        }
        // The transform of a skinned mesh's own node does not affect its appearance either.
        let seen_by = if node.skin().is_some() { self.frame } else { transform };
        if maps.atlas.sh_degree() > 0 && seen_by != DMat4::IDENTITY {
            let turn = orthogonal(seen_by);
            if turn.is_none() {
                group.is_flat = true;
                notes.push(format!("{at}: a mesh with view-dependent colour under a flat transform is not drawn"));
            }
            group.turn = turn.filter(|turn| *turn != DMat3::IDENTITY);
        }
        Ok(group)
    }

    /// Adds a group, merging it with one of the same appearance if allowed; returns its index and its first vertex
    /// there.
    fn join(&mut self, group: Group) -> Result<(usize, u32), Fault> {
        let next = self.groups.len();
        if group.atlas.is_some() || group.turn.is_some() || group.rest_surface.is_some() {
            self.groups.push(group);
            return Ok((next, 0));
        }
        let index = *self.shared.entry((group.material, group.tint)).or_insert(next);
        let Some(all) = self.groups.get_mut(index) else {
            self.groups.push(group);
            return Ok((next, 0));
        };
        let first =
            u32::try_from(all.positions.len()).ok().filter(|&n| n.checked_add(group.positions.len() as u32).is_some());
        let first = first.ok_or_else(|| Fault::whole("fewer than 2³² vertices of a material", "more"))?;
        all.positions.extend(group.positions);
        all.triangles.extend(group.triangles.iter().map(|t| t.map(|v| v + first)));
        all.corner_uvs.extend(group.corner_uvs);
        Ok((index, first))
    }

    /// Says so where what is drawn has materials of one side, whatever is on the other.
    fn sides(&self) -> Option<String> {
        let drawn: HashSet<Option<usize>> = self.groups.iter().map(|group| group.material).collect();
        let count = self.single_sided.intersection(&drawn).count();
        let materials = if count == 1 { "material is" } else { "materials are" };
        (count > 0).then(|| {
            format!("{count} single-sided {materials} drawn from both sides: glTF hides the backs of such surfaces")
        })
    }

    pub(super) fn finish(self, notes: &mut Vec<String>) -> Result<Finished, Fault> {
        notes.extend(self.sides());
        let (mut meshes, mut rest_surfaces, mut unrolling) = (vec![], vec![], Unrolling::default());
        for mut group in self.groups {
            let maps = &self.maps[&group.material];
            let tinted = group.tint.map(|tint| &self.tinted[&(group.material, tint)]);
            let atlas = group.atlas.unwrap_or_else(|| tinted.unwrap_or(&maps.atlas).clone());
            // Maps of vertex colours do not repeat, just as those of materials without a texture.
            let (atlas, said) = unrolling.unrolled(&maps.uv, atlas, &mut group.corner_uvs);
            notes.extend(said.map(|said| format!("/materials/{}: {said}", group.material.unwrap_or_default())));
            let in_material = |e: SceneError| {
                Fault::from(e).under(group.material.map_or("/meshes".to_owned(), |i| format!("/materials/{i}")))
            };
            let atlas = match group.turn {
                Some(turn) => turned(&atlas, turn).map_err(in_material)?,
                None => atlas,
            };
            let mesh = Mesh::new(group.positions, group.triangles, group.corner_uvs, atlas);
            meshes.push(mesh.map_err(in_material)?);
            rest_surfaces.push(group.rest_surface);
        }
        Ok(Finished { meshes, rest_surfaces, poses: self.poses, bindable: self.bindable })
    }
}

/// Rejects positions that are not finite, at the attribute if they are stored so, else at the node that makes them so.
fn check_positions(geometry: &Triangles, node: &gltf::Node<'_>, primitive: &gltf::Primitive<'_>) -> Result<(), Fault> {
    let Some(i) = geometry.positions.iter().position(|position| !position.is_finite()) else { return Ok(()) };
    let (mesh, primitive) = (node.mesh().map_or(0, |m| m.index()), primitive.index());
    let stored = geometry.rest_surface.base[i];
    let (at, wrong) = if stored.is_finite() {
        (format!("/nodes/{}", node.index()), geometry.positions[i])
    } else {
        (format!("/meshes/{mesh}/primitives/{primitive}/attributes/POSITION"), stored)
    };
    let number = wrong.to_array().into_iter().find(|v| !v.is_finite()).unwrap_or_default();
    let vertex = geometry.stored.kept.as_ref().map_or(i, |kept| kept[i]);
    Err(Fault::pointer(at, "positions of finite numbers", format!("{number} at vertex {vertex}")))
}

fn positions_of(primitive: &gltf::Primitive<'_>) -> Option<usize> {
    primitive.get(&gltf::Semantic::Positions).map(|accessor| accessor.index())
}

/// Accessors that more than one primitive uses as its positions.
fn common_positions(document: &gltf::Document) -> HashSet<usize> {
    let (mut met, mut common) = (HashSet::new(), HashSet::new());
    let primitives = document.meshes().flat_map(|mesh| mesh.primitives().collect::<Vec<_>>());
    common
        .extend(primitives.filter_map(|primitive| positions_of(&primitive)).filter(|&accessor| !met.insert(accessor)));
    common
}

/// Undeformed corners of triangles, in the file's order.
fn undeformed(Triangles { triangles, rest_surface, is_mirrored, .. }: &Triangles) -> Vec<[Vec3; 3]> {
    let order = if *is_mirrored { [0, 2, 1] } else { [0, 1, 2] };
    triangles.iter().map(|t| order.map(|c| rest_surface.base[t[c] as usize])).collect()
}

/// Merges vertices that `source` lists as copies at seams into the surface's own vertices, in their order; the rest
/// surface only if it `moves`.
fn join_copies(geometry: &mut Triangles, source: &[u32], moves: bool) {
    let count = source.iter().max().map_or(0, |&v| v as usize + 1);
    let (mut own, mut copies) = (vec![Vec3::ZERO; count], vec![0; count]);
    for (copy, (&v, &p)) in source.iter().zip(&geometry.positions).enumerate() {
        (own[v as usize], copies[v as usize]) = (p, copy);
    }
    geometry.triangles.as_flattened_mut().iter_mut().for_each(|v| *v = source[*v as usize]);
    geometry.positions = own;
    if moves {
        geometry.rest_surface = geometry.rest_surface.gather(&copies);
    }
}

/// Common colour of all triangle corners, if there is one.
fn one_colour(colors: &[[f32; 4]], triangles: &[[u32; 3]]) -> Option<[f32; 4]> {
    let mut of_corners = triangles.as_flattened().iter().filter_map(|&v| colors.get(v as usize));
    let first = of_corners.next()?;
    of_corners.all(|colour| colour == first).then_some(*first)
}

/// Whether some texels are completely transparent.
fn has_holes(atlas: &Atlas) -> bool {
    let nothing = activation::map_logit(0.0);
    atlas.base().texels().chunks_exact(4).any(|texel| texel[3] <= nothing)
}

/// Map of one texel.
fn plain(base: &BaseColour, colour: [f32; 4]) -> Result<Atlas, SceneError> {
    Atlas::new(Texture::new(1, 1, 4, base.texel(colour).to_vec())?, None)
}

/// Accessor of seam copies, if there is one and it is valid: one entry per vertex, less than their number, without
/// gaps, and copies at the same position.
fn surface_vertices(
    asset: &Asset,
    node: &gltf::Node<'_>,
    primitive: &gltf::Primitive<'_>,
    positions: &[Vec3],
) -> Result<Option<Vec<u32>>, Fault> {
    let Some(value) = primitive.extension_value(HYBRID) else { return Ok(None) };
    let mesh = node.mesh().map_or(0, |m| m.index());
    let at = format!("/meshes/{mesh}/primitives/{}/extensions/{HYBRID}", primitive.index());
    let surface: Surface = from_value(value, &at, &format!("a mesh primitive of {HYBRID}"))?;
    let Some(accessor) = surface.surface_vertices else { return Ok(None) };
    let source = asset.indices(accessor)?;
    let at = format!("/accessors/{accessor}");
    if source.len() != positions.len() {
        return Err(Fault::pointer(at, format!("{} surface vertices", positions.len()), source.len().to_string()));
    }
    let mut first: Vec<Option<Vec3>> = vec![None; positions.len()];
    for (&v, &position) in source.iter().zip(positions) {
        let Some(slot) = first.get_mut(v as usize) else {
            return Err(Fault::pointer(at, format!("surface vertices below {}", positions.len()), v.to_string()));
        };
        if *slot.get_or_insert(position) != position {
            return Err(Fault::pointer(at, "copies of a surface vertex in one place", format!("vertex {v} in two")));
        }
    }
    let count = first.iter().rposition(Option::is_some).map_or(0, |last| last + 1);
    if let Some(gap) = first[..count].iter().position(Option::is_none) {
        return Err(Fault::pointer(at, "surface vertices without gaps", format!("none that is {gap}")));
    }
    Ok(Some(source))
}
