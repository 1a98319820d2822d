//! Import of triangle meshes from other programs, for `--mesh FILE`: geometry and UVs, but no materials, which training
//! replaces.

mod obj;

use std::collections::{BTreeSet, HashMap};
use std::io::Read as _;
use std::path::Path;

use glam::{DVec2, Vec2, Vec3};

use super::error::{Fault, FormatError, Location, open_file, read_file, unknown};
use super::gltf::instancing::{BYTES_OF_COPY, Single, copies};
use super::gltf::triangles::{self, Triangles};
use super::gltf::{Asset, Motion, Poses, is_ours, not_placed, placements};
use super::ply::{is_of_splats, table};
use super::{has_extension, polygon};

/// Imported mesh without maps.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportedMesh {
    /// Positions `[V]`, in the file's frame (the capture's for files that Centaur wrote). All positions are distinct:
    /// vertices at the same place are welded, and seams are expressed by `corner_uvs` only.
    pub positions: Vec<Vec3>,
    /// Indices `[F]`; at least one triangle, and no triangle has the same vertex twice.
    pub triangles: Vec<[u32; 3]>,
    /// UVs `[F]` of the corners, v downwards, in 0..1; UVs outside this square are scaled into it uniformly, so that
    /// repeats of a tile get texels of their own. `None` if part of the mesh has no finite UVs, or if they belong to
    /// several materials and so do not form one atlas.
    pub corner_uvs: Option<Vec<[Vec2; 3]>>,
    /// Whether the file is a glTF of another program, which are y up. Positions are as stored all the same.
    pub y_up: bool,
    /// Notes on content of the file that is missing or changed, mainly UVs, one sentence each.
    pub notes: Vec<String>,
}

/// Reads a mesh; the format is recognised by content, or by extension for `.obj`.
///
/// * `.glb`, `.gltf`: all triangle primitives of the default scene, transformed by their nodes, including instances;
///   skins and morph targets in rest pose.
/// * `.obj`: all faces; polygons are cut into triangles.
/// * `.ply`: ASCII or binary, `face` lists; UVs per face (`texcoord`) or per vertex (`s t`, `u v`,
///   `texture_u texture_v`).
///
/// # Errors
/// If the file cannot be read, is malformed, or has no triangle.
pub fn read(path: &Path) -> Result<ImportedMesh, FormatError> {
    let is_obj = has_extension(path, &["obj"]);
    let mut start = vec![];
    let read = open_file(path)?.take(256).read_to_end(&mut start);
    read.map_err(|source| FormatError::Read { file: path.to_owned(), source })?;
    let soup = if start.starts_with(b"ply") {
        from_ply(&read_file(path)?)
    } else if is_obj {
        obj::parse(&read_file(path)?)
    } else if start.starts_with(b"glTF") || start.iter().find(|b| !b.is_ascii_whitespace()) == Some(&b'{') {
        from_gltf(&Asset::open(path)?)
    } else {
        Err(Fault::byte(0, "a .glb, .gltf, .obj or .ply mesh", unknown(&start)))
    };
    soup.and_then(Soup::finish).map_err(|fault| fault.in_file(path))
}

/// Triangles as read, before welding.
#[derive(Default)]
struct Soup {
    positions: Vec<Vec3>,
    triangles: Vec<[u32; 3]>,
    /// Per triangle, its UVs; `None` for triangles without UVs.
    corner_uvs: Vec<Option<[Vec2; 3]>>,
    materials: BTreeSet<Option<usize>>,
    /// Non-finite vertices, in order, with their places in the file: no triangle may use them.
    unusable: Vec<(u32, Location)>,
    /// Place in the file where triangles were expected.
    faces: Option<Location>,
    /// As in [`ImportedMesh`].
    y_up: bool,
    /// Notes on the triangles.
    notes: Vec<String>,
}

impl Soup {
    /// Appends one part whose indices count from its own first position. `place` gives the place in the file of one of
    /// its vertices.
    fn add(
        &mut self,
        positions: impl IntoIterator<Item = Vec3>,
        triangles: &[[u32; 3]],
        uvs: Option<Vec<Option<[Vec2; 3]>>>,
        material: Option<usize>,
        place: impl Fn(usize) -> Location,
    ) -> Result<(), Fault> {
        let too_many = || Fault::at(place(0), "fewer than 2³² vertices", "more");
        let first = u32::try_from(self.positions.len()).map_err(|_| too_many())?;
        self.positions.extend(positions);
        u32::try_from(self.positions.len()).map_err(|_| too_many())?;
        let own = &self.positions[first as usize..];
        let unusable = own.iter().enumerate().filter(|(_, p)| !p.is_finite());
        self.unusable.extend(unusable.map(|(i, _)| (first + i as u32, place(i))));
        self.triangles.extend(triangles.iter().map(|t| t.map(|v| v + first)));
        match uvs {
            Some(uvs) => self.corner_uvs.extend(uvs),
            None => self.corner_uvs.resize(self.triangles.len(), None),
        }
        self.materials.insert(material);
        Ok(())
    }

    /// Appends a glTF primitive at a JSON pointer.
    fn add_primitive(&mut self, t: Triangles, material: Option<usize>, at: &str) -> Result<(), Fault> {
        let Triangles { positions, triangles, uvs, .. } = t;
        let uvs = uvs.map(|uvs| triangles.iter().map(|t| Some(t.map(|v| uvs[v as usize]))).collect());
        self.add(positions, &triangles, uvs, material, |_| Location::Pointer(at.to_owned()))
    }

    /// UVs, if they form one atlas, and a note if they do not or were changed.
    fn atlas(&self) -> (Option<Vec<[Vec2; 3]>>, Option<String>) {
        let mut uvs: Vec<[Vec2; 3]> = self.corner_uvs.iter().flatten().copied().collect();
        let (all, given, materials) = (self.triangles.len(), uvs.len(), self.materials.len());
        let usable = uvs.iter().filter(|uvs| uvs.iter().all(|uv| uv.is_finite())).count();
        let why_not = if given == 0 {
            return (None, None);
        } else if given < all {
            format!("{} of {all} triangles have none", all - given)
        } else if usable < all {
            format!("those of {} of {all} triangles are missing or not finite", all - usable)
        } else if materials > 1 {
            format!("they belong to {materials} materials")
        } else {
            let note = scale_into_square(uvs.as_flattened_mut());
            return (Some(uvs), note);
        };
        (None, Some(format!("its UVs are not kept, new ones are made: {why_not}")))
    }

    fn finish(self) -> Result<ImportedMesh, Fault> {
        let (uvs, note) = self.atlas();
        let mut index: HashMap<[u32; 3], u32> = HashMap::new();
        let mut mesh = ImportedMesh {
            positions: vec![],
            triangles: vec![],
            corner_uvs: uvs.as_ref().map(|_| vec![]),
            y_up: self.y_up,
            notes: self.notes.into_iter().chain(note).collect(),
        };
        for (f, triangle) in self.triangles.iter().enumerate() {
            let mut welded = *triangle;
            for v in &mut welded {
                // Adding 0 turns −0 into 0.
                let p = self.positions[*v as usize] + 0.0;
                if !p.is_finite() {
                    let place = self.unusable.binary_search_by_key(v, |(vertex, _)| *vertex);
                    let place = place.map_or(Location::File, |i| self.unusable[i].1.clone());
                    return Err(Fault::at(place, "finite vertex positions", format!("{p} at vertex {v}")));
                }
                *v = *index.entry(p.to_array().map(f32::to_bits)).or_insert_with(|| {
                    mesh.positions.push(p);
                    (mesh.positions.len() - 1) as u32
                });
            }
            let [a, b, c] = welded;
            if a != b && b != c && c != a {
                mesh.triangles.push(welded);
                if let (Some(kept), Some(uvs)) = (&mut mesh.corner_uvs, &uvs) {
                    kept.push(uvs[f]);
                }
            }
        }
        if mesh.triangles.is_empty() {
            return Err(Fault::at(
                self.faces.unwrap_or(Location::Byte(0)),
                "a mesh with at least one triangle",
                format!("{} positions", self.positions.len()),
            ));
        }
        Ok(mesh)
    }
}

/// Scales UVs outside 0..1 into that square, and returns a note if it did.
fn scale_into_square(uvs: &mut [Vec2]) -> Option<String> {
    let low = uvs.iter().copied().fold(Vec2::ZERO, Vec2::min).as_dvec2();
    let high = uvs.iter().copied().fold(Vec2::ONE, Vec2::max).as_dvec2();
    if (low, high) == (DVec2::ZERO, DVec2::ONE) {
        return None;
    }
    let extent = (high - low).max_element();
    uvs.iter_mut().for_each(|uv| *uv = ((uv.as_dvec2() - low) / extent).as_vec2());
    Some(format!("its UVs leave 0..1 and are scaled into that range, by 1/{:?}", extent as f32))
}

fn from_gltf(asset: &Asset) -> Result<Soup, Fault> {
    asset.check_required()?;
    let faces = Some(Location::Pointer("/meshes".to_owned()));
    let y_up = !is_ours(&asset.document);
    let mut soup = Soup { faces, y_up, notes: not_placed(asset)?, ..Soup::default() };
    // Rest pose.
    let motion = Motion::default();
    let mut poses = Poses::new(&asset.document, &motion)?;
    let single = Single::of(&asset.root);
    for (node, transform) in placements(&asset.document)? {
        let copies = copies(asset, &single, &node, &mut soup.notes)?;
        for primitive in node.mesh().iter().flat_map(gltf::Mesh::primitives) {
            let id = (node.mesh().map_or(0, |m| m.index()), primitive.index());
            let at = format!("/meshes/{}/primitives/{}", id.0, id.1);
            if !asset.has_positions(id) {
                soup.notes.push(format!("{at}: left out: it has no POSITION"));
                continue;
            }
            let place = (&node, transform);
            let read = triangles::read((asset, &motion), &mut poses, place, &primitive, 0, &mut soup.notes)?;
            let Some(t) = read else { continue };
            let material = primitive.material().index();
            let Some(copies) = &copies else {
                soup.add_primitive(t, material, &at)?;
                continue;
            };
            let bytes = BYTES_OF_COPY + t.positions.len() as u64 * 12 + t.triangles.len() as u64 * 40;
            for local in copies {
                asset.spend(bytes, &at)?;
                soup.add_primitive(t.copy(&mut poses, place, *local), material, &at)?;
            }
        }
    }
    Ok(soup)
}

fn from_ply(bytes: &[u8]) -> Result<Soup, Fault> {
    let (header, mut body) = table::open(std::io::Cursor::new(bytes))?;
    let vertex = header.required("vertex")?;
    if header.element("face").is_none() && is_of_splats(&header) {
        return Err(Fault::byte(vertex.at, "a mesh, of vertices and faces", "splats, which have no faces"));
    }
    let [x, y, z] = vertex.scalars(["x", "y", "z"])?;
    let names = [["s", "t"], ["u", "v"], ["texture_u", "texture_v"]];
    let uv_columns = names.into_iter().find_map(|n| vertex.scalars(n).ok());
    let (positions, vertex_uvs, unusable) = body.rows(
        &header,
        "vertex",
        |n| (Vec::with_capacity(n), vec![], vec![]),
        |(positions, uvs, unusable), row| {
            let v = |column: usize| row.values[column] as f32;
            let position = Vec3::new(v(x), v(y), v(z));
            unusable.extend((!position.is_finite()).then_some((positions.len(), row.at)));
            positions.push(position);
            uvs.extend(uv_columns.map(|[s, t]| Vec2::new(v(s), 1.0 - v(t))));
            Ok(())
        },
    )?;

    let face = header.required("face")?;
    let corners = face.list("vertex_indices").or_else(|| face.list("vertex_index"));
    let corners =
        corners.ok_or_else(|| Fault::byte(face.at, "the face property `vertex_indices`", "a header without it"))?;
    let face_uvs = face.list("texcoord");
    // Column with the index of the texture to which a face's UVs refer.
    let of_texture = face.scalars(["texnumber"]).ok().filter(|_| face_uvs.is_some());
    let (triangles, uvs, textures) = body.rows(
        &header,
        "face",
        |n| (Vec::with_capacity(n), vec![], BTreeSet::new()),
        |(triangles, uvs, textures), row| {
            // −1 means no texture.
            let texture = of_texture.map(|[column]| row.values[column]).filter(|&number| number >= 0.0);
            textures.insert(texture.map(|number| number as usize));
            let polygon = &row.lists[corners];
            if let Some(bad) = polygon.iter().find(|&&v| !(v >= 0.0 && (v as usize) < positions.len())) {
                let expected = format!("vertex indices below {}", positions.len());
                return Err(Fault::byte(row.at, expected, format!("{bad} in a face")));
            }
            let texcoords = face_uvs.map_or(&[][..], |column| &row.lists[column]);
            let has_own = texcoords.len() == 2 * polygon.len();
            // PLY has v upwards by convention of the programs that write UVs.
            let own = |corner: usize| Vec2::new(texcoords[2 * corner] as f32, 1.0 - texcoords[2 * corner + 1] as f32);
            let outline: Vec<Vec3> = polygon.iter().map(|&v| positions[v as usize]).collect();
            for triangle in polygon::triangles(&outline) {
                triangles.push(triangle.map(|corner| polygon[corner] as u32));
                let of_vertices = || uv_columns.map(|_| triangle.map(|corner| vertex_uvs[polygon[corner] as usize]));
                uvs.push(if has_own { Some(triangle.map(own)) } else { of_vertices() });
            }
            Ok(())
        },
    )?;
    let mut soup = Soup { faces: Some(Location::Byte(face.at as u64)), ..Soup::default() };
    let place = |i: usize| {
        let known = unusable.binary_search_by_key(&i, |(vertex, _)| *vertex);
        Location::Byte(known.map_or(vertex.at, |k| unusable[k].1) as u64)
    };
    soup.add(positions, &triangles, Some(uvs), None, place)?;
    soup.materials = textures;
    Ok(soup)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const QUAD_OBJ: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 0.75\nf 1/1 2/2 3/3 4/4\n";
    const QUAD_PLY: &str = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n\
        property float z\nproperty float s\nproperty float t\nelement face 1\nproperty list uchar uint vertex_indices\n\
        end_header\n0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 1\n0 1 0 0 0.75\n4 0 1 2 3\n";

    #[test]
    fn a_quad_from_obj_and_ply_is_the_same() {
        let obj = obj::parse(QUAD_OBJ.as_bytes()).and_then(Soup::finish).unwrap();
        assert_eq!(obj.positions.len(), 4);
        assert_eq!(obj.triangles, [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(obj.corner_uvs.as_ref().unwrap()[1][2], Vec2::new(0.0, 0.25), "v is flipped");
        assert_eq!(from_ply(QUAD_PLY.as_bytes()).and_then(Soup::finish).unwrap(), obj);
    }

    #[test]
    fn concave_polygons_keep_their_area() {
        let vertices = ["0 0 0", "2 0 0", "2 2 0", "1 .5 0", "0 2 0"];
        let obj = format!("v {}\nf 1 2 3 4 5\n", vertices.join("\nv "));
        let ply = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n\
            element face 1\nproperty list uchar int vertex_indices\nend_header\n";
        let ply = format!("{ply}{}\n5 0 1 2 3 4\n", vertices.join("\n"));
        for soup in [obj::parse(obj.as_bytes()), from_ply(ply.as_bytes())] {
            let mesh = soup.and_then(Soup::finish).unwrap();
            let corners = mesh.triangles.iter().map(|t| t.map(|v| mesh.positions[v as usize]));
            let areas: Vec<f32> = corners.map(|[a, b, c]| 0.5 * (b - a).cross(c - a).z).collect();
            assert!(areas.iter().all(|&a| a > 0.0) && areas.iter().sum::<f32>() == 2.5, "{areas:?}");
        }
    }

    #[test]
    fn comments_end_with_their_line() {
        let begun = "v 0 0 0\nv 1 0 0\n# from C:\\scans\\\nv 1 \\\n 1 0\nf 1 2 3\n";
        let mesh = obj::parse(begun.as_bytes()).and_then(Soup::finish).unwrap();
        assert_eq!((mesh.positions.len(), mesh.triangles.len()), (3, 1));
    }

    #[test]
    fn joined_vertices_and_degenerate_faces() {
        let obj = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 0 -0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 4 5 6\nf 1 2 4\n";
        let mesh = obj::parse(obj.as_bytes()).and_then(Soup::finish).unwrap();
        assert_eq!((mesh.positions.len(), mesh.triangles.len(), mesh.corner_uvs), (4, 2, None));
    }

    #[test]
    fn uvs_that_tile_are_scaled() {
        let tiled = QUAD_OBJ.replace("vt 1 1", "vt 1 3");
        let mesh = obj::parse(tiled.as_bytes()).and_then(Soup::finish).unwrap();
        // v = 3 becomes −2 downwards: the top of the range −2..1, which is 3 long; u is scaled in proportion.
        let expected = [Vec2::new(0.0, 1.0), Vec2::new(1.0 / 3.0, 1.0), Vec2::new(1.0 / 3.0, 0.0)];
        assert_eq!(mesh.corner_uvs.unwrap()[0], expected);
        assert_eq!(mesh.notes, ["its UVs leave 0..1 and are scaled into that range, by 1/3.0"]);
        let widest = QUAD_OBJ.replace("vt 1 1", "vt 3e38 -3e38");
        let uvs = obj::parse(widest.as_bytes()).and_then(Soup::finish).unwrap().corner_uvs.unwrap();
        assert!(uvs.as_flattened().iter().all(|uv| uv.min_element() >= 0.0 && uv.max_element() <= 1.0), "{uvs:?}");
    }

    #[test]
    fn uvs_that_are_not_kept_are_noted() {
        let noted = |soup: Result<Soup, Fault>| {
            let mesh = soup.and_then(Soup::finish).unwrap();
            assert_eq!(mesh.corner_uvs, None);
            let [note] = &mesh.notes[..] else { panic!("{:?}", mesh.notes) };
            note.strip_prefix("its UVs are not kept, new ones are made: ").unwrap().to_owned()
        };
        let noted_obj = |text: &str| noted(obj::parse(text.as_bytes()));
        let face = "f 1/1 2/2 3/3 4/4\n";
        let two = QUAD_OBJ.replace(face, &format!("usemtl a\n{face}usemtl b\n{face}"));
        assert_eq!(noted_obj(&two), "they belong to 2 materials");
        assert_eq!(noted_obj(&format!("{QUAD_OBJ}f 1 2 3\n")), "1 of 3 triangles have none");
        let lost = "those of 1 of 2 triangles are missing or not finite";
        assert_eq!(noted_obj(&QUAD_OBJ.replace("4/4", "4/5")), lost);
        assert_eq!(noted_obj(&QUAD_OBJ.replace("vt 0 0.75", "vt nan 0")), lost);
        assert_eq!(noted(from_ply(QUAD_PLY.replace("0 0.75", "0 nan").as_bytes())), lost);
        let bare = obj::parse(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").and_then(Soup::finish).unwrap();
        assert!(bare.notes.is_empty(), "there were none");
    }

    /// As `MeshLab` writes a mesh with several textures.
    #[test]
    fn uvs_on_several_textures_are_no_atlas() {
        let header = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
            element face 2\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\n\
            property int texnumber\nend_header\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n";
        let read = |second: i32| {
            let faces = format!("3 0 1 2 6 0 0 1 0 1 1 0\n3 0 2 3 6 0 0 1 1 0 1 {second}\n");
            from_ply(format!("{header}{faces}").as_bytes()).and_then(Soup::finish).unwrap()
        };
        assert!(read(0).corner_uvs.is_some());
        assert!(read(-1).corner_uvs.is_none(), "a face without a texture has no place on that of another");
        let two = read(1);
        assert!(two.corner_uvs.is_none() && two.notes[0].contains("they belong to 2 materials"), "{:?}", two.notes);
    }

    #[test]
    fn meshes_without_triangles_are_refused() {
        let message =
            |soup: Result<Soup, Fault>| soup.and_then(Soup::finish).unwrap_err().in_file(Path::new("m")).to_string();
        assert_eq!(
            message(obj::parse(b"v 0 0 0\n")),
            "m: byte 8: expected a mesh with at least one triangle, found 1 positions"
        );
        assert!(message(from_ply(QUAD_PLY.replace("4 0 1 2 3", "4 0 1 2 4").as_bytes())).contains("below 4, found 4"));
        assert_eq!(
            message(obj::parse(b"v 0 0 0\nf 1 2 3\n")),
            "m: byte 8: expected a face of the 1 vertices in the OBJ, found vertex 2"
        );
        for (text, found) in [
            ("v 0 zero 0\n", "byte 0: expected coordinates as in an OBJ, found `v 0 zero 0`"),
            ("v 0 0 0\nf 0 1 1\n", "byte 8: expected a face of indices as in an OBJ, found `0`"),
            ("v 0 0 0\nf 1 1 -2\n", "byte 8: expected a face of indices as in an OBJ, found `-2`"),
            ("v 0 0 0\nf 1/-1 1 1\n", "found `1/-1`"),
            ("v 0 0 0\nf 1 1 9223372036854775808\n", "found `9223372036854775808`"),
        ] {
            assert!(message(obj::parse(text.as_bytes())).contains(found), "{}", message(obj::parse(text.as_bytes())));
        }
    }

    #[test]
    fn what_obj_allows() {
        // Relative indices, normals, a colour after the position, a continued line, and faces before their vertices.
        let text =
            "f 1//1 2//1 3//1\r\nv 0 0 0 1 1 1\r\nvn 0 0 1\r\nv 1 0 \\\r\n0\r\nv 0 1 0\r\nf -3 -2 -1\r\nl 1 2\r\n";
        let mesh = obj::parse(text.as_bytes()).and_then(Soup::finish).unwrap();
        assert_eq!((mesh.positions, mesh.triangles), (vec![Vec3::ZERO, Vec3::X, Vec3::Y], vec![[0, 1, 2]; 2]));
        let marked = obj::parse(format!("\u{feff}v 2 0 0\n{}", text.replace("f 1//1 2//1 3//1", "f 1 3 4")).as_bytes());
        assert_eq!(marked.and_then(Soup::finish).unwrap().positions[0], 2.0 * Vec3::X, "after a byte order mark");
        let part_without = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0\nf 1/1 2/1 3/1\nf 1 2 3\n";
        assert!(obj::parse(part_without.as_bytes()).and_then(Soup::finish).unwrap().corner_uvs.is_none());
    }

    proptest! {
        #[test]
        fn damaged_files_do_not_panic(cut in 1usize..400, at in 0usize..400, byte: u8) {
            for (text, parse) in [(QUAD_OBJ, obj::parse as fn(&[u8]) -> _), (QUAD_PLY, from_ply)] {
                let mut file = text.as_bytes().to_vec();
                file.truncate(cut);
                let at = at % file.len();
                file[at] = byte;
                let _ = parse(&file).and_then(Soup::finish);
            }
        }
    }
}
