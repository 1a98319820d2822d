//! Opening of a glTF file: removes from the JSON what the `gltf` crate cannot represent, passes the rest (the core:
//! nodes, meshes, materials, accessors, cameras) to the crate, locates the buffers, which stay in their files, and
//! decompresses buffer views; documents with compressed views have their buffers loaded.
//!
//! The crate merges all attributes with a `:` in the name into one key and rejects unknown extensions in
//! `extensionsRequired`; both are removed here, and nowhere else. It also rejects accessors without data (all zeros, or
//! data given by an extension), which get a buffer view beyond those of the file, and primitives without positions,
//! which get an accessor beyond those of the file.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use serde_json::{Value, json};

use super::buffer::{Buffer, Input};
use super::extension::{
    EMISSIVE_STRENGTH, HYBRID, INSTANCING, KHR_SPLATS, SPECULAR_GLOSSINESS, SPZ, TEXTURE_TRANSFORM, UNLIT, VISIBILITY,
    WEBP,
};
use super::integers::write_as_integers;
use super::json::{index, indices, items, items_mut, primitives, primitives_mut, remove, strings};
use super::uri::open_once;
use super::{glb, meshopt};
use crate::format::error::{Fault, FormatError, VALID_GLTF, from_json, from_value, read_file, shown};

/// Attributes not defined by the core, by (mesh, primitive): name → accessor.
type Attributes = HashMap<(usize, usize), BTreeMap<String, usize>>;

/// An opened glTF file.
pub(in crate::format) struct Asset {
    /// Core document.
    pub(in crate::format) document: gltf::Document,
    /// JSON as in the file, except for the `uri`s of buffers, whose content is in `buffers`, and for integers, which
    /// are written as such.
    pub(in crate::format) root: Value,
    /// Attributes such as `KHR_gaussian_splatting:SCALE`.
    pub(in crate::format) attributes: Attributes,
    /// Primitives (mesh, index in the mesh) without positions, which have substitutes in the core document.
    unplaced: HashSet<(usize, usize)>,
    /// `extensionsUsed` and `extensionsRequired` of the file.
    pub(in crate::format) extensions_used: Vec<String>,
    pub(in crate::format) extensions_required: Vec<String>,
    /// Length of the JSON text in bytes.
    pub(in crate::format) json_bytes: usize,
    /// Sizes of buffers outside the chunk of a `.glb`.
    pub(super) places: Places,
    /// One per glTF buffer, at least as long as declared; empty where all views of it are stored compressed.
    pub(super) buffers: Vec<Buffer>,
    /// Decompressed buffer views, by index.
    pub(super) plain_views: HashMap<usize, Vec<u8>>,
    /// Folder of the file, which may contain images and buffers.
    pub(super) folder: PathBuf,
    /// Length of the buffers in bytes, and of the decompressed views (`view_bytes`).
    buffer_bytes: usize,
    view_bytes: usize,
    /// Bytes of arrays made from the file so far, see [`Asset::spend`].
    spent: AtomicU64,
    /// Upper bound on `spent`.
    most: u64,
}

/// Sizes in bytes of buffers that are not a chunk of a `.glb`.
#[derive(Clone, Copy, Default)]
pub(super) struct Places {
    /// Data URIs in the JSON text (`uris`), and their decoded content (`embedded`).
    pub(super) uris: usize,
    pub(super) embedded: usize,
    /// Separate files, each counted once.
    pub(super) beside: usize,
}

/// Bytes of arrays allowed per byte of the file, beyond the amount allowed for any file (`ALWAYS`). Accessors used in
/// many places and meshes at many nodes multiply memory; real files stay far below.
const MAX_RATIO: u64 = 512;
const ALWAYS: u64 = 1 << 30;

/// Animation paths of the core.
const PATHS: [&str; 4] = ["translation", "rotation", "scale", "weights"];

/// Extensions that may be required and are implemented here.
const UNDERSTOOD: [&str; 13] = [
    KHR_SPLATS,
    HYBRID,
    SPZ,
    UNLIT,
    EMISSIVE_STRENGTH,
    SPECULAR_GLOSSINESS,
    TEXTURE_TRANSFORM,
    WEBP,
    meshopt::NAMES[0],
    meshopt::NAMES[1],
    VISIBILITY,
    INSTANCING,
    // Quantised attributes are read like any others.
    "KHR_mesh_quantization",
];

/// Extensions that do not affect the base colour, the only part shown: files that require them are read without, with a
/// note.
const UNSHOWN: [&str; 13] = [
    "EXT_mesh_features",
    "EXT_structural_metadata",
    "KHR_animation_pointer",
    "KHR_lights_punctual",
    "KHR_materials_anisotropy",
    "KHR_materials_clearcoat",
    "KHR_materials_dispersion",
    "KHR_materials_ior",
    "KHR_materials_iridescence",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_materials_variants",
    "KHR_xmp_json_ld",
];

/// Expectation stated for an unsupported required extension; `None` if a file that requires it can be read. The list of
/// supported ones would be too long for a line.
pub(in crate::format) fn expected_for(required: &str) -> Option<&'static str> {
    let is_known = UNDERSTOOD.into_iter().chain(UNSHOWN).any(|name| name == required);
    (!is_known).then_some("a supported extension, or one that does not change what is shown")
}

impl Asset {
    /// Opens a `.glb` or `.gltf` file with all its buffers.
    pub(in crate::format) fn open(path: &Path) -> Result<Self, FormatError> {
        let read = |source| FormatError::Read { file: path.to_owned(), source };
        let folder = path.parent().unwrap_or(Path::new("")).to_owned();
        let mut input = Input::open(path).map_err(read)?;
        let mut start = vec![];
        input.file().take(glb::MAGIC.len() as u64).read_to_end(&mut start).map_err(read)?;
        let opened = if start == glb::MAGIC {
            glb::split(input.file()).and_then(|glb::Chunks { json, bin }| {
                Self::of_json(json, glb::JSON_OFFSET, bin.map(|range| input.section(range)), folder)
            })
        } else {
            Self::of_json(read_file(path)?, 0, None, folder)
        };
        opened.map_err(|fault| fault.in_file(path))
    }

    /// Same as [`Self::open`], for a file in memory.
    #[cfg(test)]
    pub(super) fn parse(bytes: &[u8], folder: PathBuf) -> Result<Self, Fault> {
        if !bytes.starts_with(glb::MAGIC) {
            return Self::of_json(bytes.to_vec(), 0, None, folder);
        }
        let glb::Chunks { json, bin } = glb::split(&mut std::io::Cursor::new(bytes))?;
        Self::of_json(json, glb::JSON_OFFSET, bin.map(|range| bytes[range].to_vec().into()), folder)
    }

    fn of_json(json: Vec<u8>, offset: usize, bin: Option<Buffer>, folder: PathBuf) -> Result<Self, Fault> {
        let json_bytes = json.len();
        let mut root: Value = from_json(&json, offset, "glTF JSON")?;
        write_as_integers(&mut root);
        // Freed early, because the text may contain all buffers.
        drop(json);
        let [extensions_used, extensions_required] =
            ["extensionsUsed", "extensionsRequired"].map(|key| strings(&root, key).map(str::to_owned).collect());
        let (buffers, places) = load_buffers(&mut root, bin, &folder)?;
        let Core { document, attributes, unplaced } = core(&root)?;
        let in_memory = |i: usize| match buffers.get(i) {
            Some(Buffer::Memory(bytes)) => Some(bytes.as_slice()),
            // Only without compressed views: else all buffers have been loaded.
            Some(Buffer::File { .. }) | None => None,
        };
        let plain_views = meshopt::decompress(&root, in_memory).collect::<Result<HashMap<_, _>, _>>()?;
        // Buffers in the same place are counted once.
        let mut starts = HashSet::new();
        let buffer_bytes = buffers.iter().filter(|buffer| starts.insert(buffer.place())).map(Buffer::len).sum();
        let view_bytes = plain_views.values().map(Vec::len).sum();
        Ok(Self {
            most: ((buffer_bytes + json_bytes) as u64).saturating_mul(MAX_RATIO).saturating_add(ALWAYS),
            document,
            root,
            attributes,
            unplaced,
            extensions_used,
            extensions_required,
            json_bytes,
            places,
            buffers,
            plain_views,
            folder,
            buffer_bytes,
            view_bytes,
            spent: AtomicU64::new(0),
        })
    }

    /// Total length of the buffers, counting those in the same place once.
    pub(super) fn buffer_bytes(&self) -> usize {
        self.buffer_bytes
    }

    /// Total length of the data to which the document refers.
    pub(super) fn stored_bytes(&self) -> usize {
        self.buffer_bytes + self.view_bytes
    }

    /// Counts the memory in bytes taken by something at `at`, before or after it is allocated; a single allocation is
    /// at most proportional to the file's size.
    ///
    /// # Errors
    /// If the total counted exceeds the limit for this file.
    pub(in crate::format) fn spend(&self, bytes: u64, at: &str) -> Result<(), Fault> {
        let add = |spent: u64| Some(spent.saturating_add(bytes));
        let spent = self.spent.fetch_update(Ordering::Relaxed, Ordering::Relaxed, add).unwrap_or_default();
        if spent.saturating_add(bytes) <= self.most {
            return Ok(());
        }
        let expected = format!("at most {} bytes of arrays from a file of this size", self.most);
        Err(Fault::pointer(at, expected, "more, by repeated use"))
    }

    /// Whether primitive `id` (mesh, index in the mesh) has positions. Without positions it is not shown (glTF 2.0,
    /// 3.7.2.1), unless an extension provides them.
    pub(in crate::format) fn has_positions(&self, id: (usize, usize)) -> bool {
        !self.unplaced.contains(&id)
    }

    /// Positions of a primitive, if it has any.
    pub(super) fn positions<'a>(
        &self,
        id: (usize, usize),
        primitive: &gltf::Primitive<'a>,
    ) -> Option<gltf::Accessor<'a>> {
        primitive.get(&gltf::Semantic::Positions).filter(|_| self.has_positions(id))
    }

    /// Whether a buffer view is one of the file's, not one added here.
    pub(super) fn has_view(&self, view: &gltf::buffer::View<'_>) -> bool {
        view.index() < items(&self.root, "bufferViews").len()
    }

    /// Per channel of an animation in the core document, its index in the file.
    pub(super) fn channels(&self, animation: usize) -> Vec<usize> {
        let nodes = items(&self.root, "nodes").len();
        let channels = items(&self.root, "animations").get(animation).map(|animation| items(animation, "channels"));
        let channels = channels.into_iter().flatten().enumerate();
        channels.filter(|(_, channel)| is_core_channel(channel, nodes)).map(|(i, _)| i).collect()
    }

    /// Rejects files of unsupported versions: of another major version, or with a minor version stated as required.
    pub(super) fn check_version(&self) -> Result<(), Fault> {
        for (key, newest_minor) in [("version", u32::MAX), ("minVersion", 0)] {
            let at = format!("/asset/{key}");
            let Some(stated) = self.root.pointer(&at) else { continue };
            let text = stated.as_str().map_or_else(|| stated.to_string(), str::to_owned);
            let mut parts = text.split('.').map(str::parse::<u32>);
            let is_understood = matches!(parts.next(), Some(Ok(2)))
                && parts.next().is_none_or(|minor| minor.is_ok_and(|minor| minor <= newest_minor));
            if !is_understood {
                return Err(Fault::pointer(
                    at,
                    "glTF 2.0, or a later 2.x that can be read as 2.0",
                    shown(text.as_bytes()),
                ));
            }
        }
        Ok(())
    }

    /// Same as [`Self::check_version`], and rejects files that require unsupported extensions.
    pub(in crate::format) fn check_required(&self) -> Result<(), Fault> {
        self.check_version()?;
        let refused = self.extensions_required.iter().find_map(|name| Some((name, expected_for(name)?)));
        refused.map_or(Ok(()), |(name, expected)| {
            Err(Fault::pointer("/extensionsRequired", expected, format!("`{name}`")))
        })
    }

    /// Required extensions without which the file is read nevertheless.
    pub(super) fn unshown(&self) -> impl Iterator<Item = &str> {
        self.extensions_required.iter().map(String::as_str).filter(|name| UNSHOWN.contains(name))
    }
}

/// Core document validated by the crate, and the content removed from it.
struct Core {
    document: gltf::Document,
    attributes: Attributes,
    unplaced: HashSet<(usize, usize)>,
}

fn core(root: &Value) -> Result<Core, Fault> {
    let mut core = root.clone();
    remove(&mut core, "extensionsRequired");
    let attributes = lift_attributes(&mut core)?;
    let unplaced = fill_positions(&mut core);
    lift_channels(&mut core)?;
    fill_accessors(&mut core);
    fill_bounds(&mut core);
    give_scene(&mut core);
    let core: gltf::json::Root = from_value(&core, "", "glTF 2.0 JSON")?;
    let document = gltf::Document::from_json(core).map_err(|e| match e {
        gltf::Error::Validation(faults) if !faults.is_empty() => {
            let (path, error) = &faults[0];
            Fault::pointer(rfc6901(path.as_str()), VALID_GLTF, error.to_string().to_lowercase())
        }
        other => Fault::pointer("/", VALID_GLTF, other.to_string()),
    })?;
    Ok(Core { document, attributes, unplaced })
}

/// Converts a path to a JSON pointer: `meshes[0].primitives[1]` → `/meshes/0/primitives/1`.
fn rfc6901(path: &str) -> String {
    let mut pointer = String::from("/");
    for c in path.chars() {
        match c {
            '.' | '[' => pointer.push('/'),
            ']' | '"' => {}
            c => pointer.push(c),
        }
    }
    pointer
}

/// Removes all attributes except positions and texture coordinates from the core.
fn lift_attributes(root: &mut Value) -> Result<Attributes, Fault> {
    let accessors = items(root, "accessors").len();
    let mut lifted = HashMap::new();
    for ((m, p), primitive) in primitives_mut(root) {
        let Some(attributes) = primitive.get_mut("attributes").and_then(Value::as_object_mut) else { continue };
        let mut others = BTreeMap::new();
        for (name, value) in attributes.iter() {
            // The crate uses POSITION as an index before checking it.
            let index = value.as_u64().and_then(|i| usize::try_from(i).ok()).filter(|&i| i < accessors);
            let index = index.ok_or_else(|| {
                let at = format!("/meshes/{m}/primitives/{p}/attributes/{name}");
                Fault::pointer(at, format!("an accessor below {accessors}"), value.to_string())
            })?;
            if !is_core(name) {
                others.insert(name.clone(), index);
            }
        }
        attributes.retain(|name, _| is_core(name));
        lifted.insert((m, p), others);
    }
    Ok(lifted)
}

/// Gives primitives without positions those of an accessor beyond those of the file; returns these primitives.
fn fill_positions(core: &mut Value) -> HashSet<(usize, usize)> {
    let accessor = items(core, "accessors").len();
    let mut filled = HashSet::new();
    for (id, primitive) in primitives_mut(core) {
        let attributes = primitive.get_mut("attributes").and_then(Value::as_object_mut);
        if let Some(attributes) = attributes.filter(|attributes| !attributes.contains_key("POSITION")) {
            attributes.insert("POSITION".to_owned(), json!(accessor));
            filled.insert(id);
        }
    }
    if !filled.is_empty() {
        let bound = [0, 0, 0];
        let one = json!({ "componentType": 5126, "type": "VEC3", "count": 1, "min": bound, "max": bound });
        append(core, "accessors", one);
    }
    filled
}

/// Appends an item to a list of a document. Anything else in its place stays, for the crate to reject.
fn append(core: &mut Value, key: &str, item: Value) {
    let list = core.as_object_mut().and_then(|core| core.entry(key).or_insert_with(|| json!([])).as_array_mut());
    if let Some(list) = list {
        list.push(item);
    }
}

/// Removes all animation channels that do not animate nodes; these belong to extensions (`KHR_animation_pointer`), or
/// are to be ignored. The crate does not validate a channel's node and path.
fn lift_channels(root: &mut Value) -> Result<(), Fault> {
    let nodes = items(root, "nodes").len();
    for (a, animation) in items_mut(root, "animations").iter_mut().enumerate() {
        let Some(channels) = animation.get_mut("channels").and_then(Value::as_array_mut) else { continue };
        for (c, channel) in channels.iter().enumerate() {
            let at = || format!("/animations/{a}/channels/{c}/target");
            let Some(target) = channel.get("target").filter(|target| target.get("extensions").is_none()) else {
                continue;
            };
            let path = target.get("path").unwrap_or(&Value::Null);
            if !path.as_str().is_some_and(|path| PATHS.contains(&path)) {
                let found = path.as_str().map_or_else(|| path.to_string(), str::to_owned);
                return Err(Fault::pointer(format!("{}/path", at()), PATHS.join(", "), shown(found.as_bytes())));
            }
            if let Some(node) = target.get("node").filter(|n| n.as_u64().is_none_or(|n| n >= nodes as u64)) {
                let expected = format!("a node below {nodes}");
                return Err(Fault::pointer(format!("{}/node", at()), expected, shown(node.to_string().as_bytes())));
            }
        }
        channels.retain(|channel| is_core_channel(channel, nodes));
    }
    Ok(())
}

/// Whether an animation channel animates one of `nodes` nodes.
fn is_core_channel(channel: &Value, nodes: usize) -> bool {
    let target = channel.get("target").unwrap_or(&Value::Null);
    let is_core = target.get("path").and_then(Value::as_str).is_some_and(|path| PATHS.contains(&path));
    is_core && index(target, "node").is_some_and(|node| node < nodes)
}

/// Gives accessors without data a buffer view that [`Asset::has_view`] does not count.
fn fill_accessors(core: &mut Value) {
    let view = items(core, "bufferViews").len();
    let mut filled = false;
    for accessor in items_mut(core, "accessors") {
        if let Some(accessor) =
            accessor.as_object_mut().filter(|a| !a.contains_key("bufferView") && !a.contains_key("sparse"))
        {
            accessor.insert("bufferView".to_owned(), json!(view));
            filled = true;
        }
    }
    if filled {
        append(core, "bufferViews", json!({ "buffer": 0, "byteLength": 1 }));
        append(core, "buffers", json!({ "byteLength": 1 }));
    }
}

/// Gives positions without bounds some, which the crate requires but which are not used.
fn fill_bounds(core: &mut Value) {
    let positions = primitives(core).filter_map(|(_, primitive)| index(primitive.get("attributes")?, "POSITION"));
    let positions: HashSet<usize> = positions.collect();
    for (_, accessor) in items_mut(core, "accessors").iter_mut().enumerate().filter(|(i, _)| positions.contains(i)) {
        let Some(accessor) = accessor.as_object_mut() else { continue };
        for key in ["min", "max"] {
            if accessor.get(key).is_none_or(Value::is_null) {
                accessor.insert(key.to_owned(), json!([0, 0, 0]));
            }
        }
    }
}

/// Whether a document defines scenes.
pub(super) fn has_scenes(root: &Value) -> bool {
    root.get("scenes").is_some_and(|scenes| scenes.as_array().is_none_or(|scenes| !scenes.is_empty()))
}

/// Gives a document without scenes a scene of all nodes that have no parent.
pub(super) fn give_scene(root: &mut Value) {
    let nodes = items(root, "nodes");
    let children: HashSet<u64> = nodes.iter().flat_map(|node| indices(node, "children")).collect();
    let tops: Vec<u64> = (0..nodes.len() as u64).filter(|node| !children.contains(node)).collect();
    if !has_scenes(root) && !tops.is_empty() {
        root["scenes"] = json!([{ "nodes": tops }]);
    }
}

fn is_core(name: &str) -> bool {
    name == "POSITION" || name.starts_with("TEXCOORD_")
}

/// Loads or locates the content of every buffer, and removes the buffers' URIs from the JSON.
fn load_buffers(root: &mut Value, bin: Option<Buffer>, folder: &Path) -> Result<(Vec<Buffer>, Places), Fault> {
    let views = items(root, "bufferViews");
    let has_compressed = views.iter().any(|v| meshopt::of_view(v).is_some());
    // The uncompressed fallback of a compressed view is not needed, and often absent.
    let stored = |v: &Value| meshopt::of_view(v).map_or(v, |(_, compressed)| compressed).get("buffer")?.as_u64();
    let needed: HashSet<u64> = views.iter().filter_map(stored).collect();
    let (mut buffers, mut bin, mut known, mut places) = (vec![], bin, HashMap::new(), Places::default());
    for (i, buffer) in items_mut(root, "buffers").iter_mut().enumerate() {
        let at = format!("/buffers/{i}");
        let length = buffer.get("byteLength").and_then(Value::as_u64);
        let length = length.ok_or_else(|| Fault::pointer(format!("{at}/byteLength"), "a number of bytes", "none"))?;
        let chunk = bin.take().filter(|_| i == 0);
        if chunk.is_none() && has_compressed && !needed.contains(&(i as u64)) {
            buffers.push(vec![].into());
            continue;
        }
        let uri = remove(buffer, "uri");
        let data = match (uri.as_ref().and_then(Value::as_str), chunk) {
            (None, Some(bin)) if has_compressed => {
                bin.into_bytes().map_err(|e| Fault::pointer(&at, format!("{length} bytes"), e.to_string()))?.into()
            }
            (None, Some(bin)) => bin,
            (None, None) => return Err(Fault::pointer(at, "a uri or a GLB binary chunk", "neither")),
            (Some(uri), _) => {
                let opened = open_once(uri, folder, &mut known, has_compressed);
                let data = opened.map_err(|(expected, found)| Fault::pointer(format!("{at}/uri"), expected, found))?;
                if uri.starts_with("data:") {
                    places.uris += uri.len();
                    places.embedded += data.len();
                }
                data
            }
        };
        if (data.len() as u64) < length {
            let expected = format!("{length} bytes");
            return Err(Fault::pointer(format!("{at}/byteLength"), expected, format!("{} bytes", data.len())));
        }
        buffers.push(data);
    }
    places.beside = known.values().map(Buffer::len).sum();
    Ok((buffers, places))
}
