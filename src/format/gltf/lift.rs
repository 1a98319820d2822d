//! Opens a glTF file: takes out of the JSON what the `gltf` crate cannot hold, gives the rest (the core: nodes, meshes,
//! materials, accessors, cameras) to it, and loads the buffers.
//!
//! The crate collapses all attributes with a `:` in the name into one key and refuses extensions that it does not know
//! in `extensionsRequired`; both are lifted out here, and nowhere else.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use serde_json::Value;

use super::extension::{HYBRID, KHR_SPLATS, UNLIT};
use super::glb;
use crate::format::error::{Fault, FormatError, read_file};

/// Attributes that the core does not define, by (mesh, primitive): name → accessor.
type Attributes = HashMap<(usize, usize), BTreeMap<String, usize>>;

/// An opened glTF file.
pub(in crate::format) struct Asset {
    /// The core.
    pub(in crate::format) document: gltf::Document,
    /// `KHR_gaussian_splatting:SCALE` and its like.
    pub(in crate::format) attributes: Attributes,
    /// `extensionsUsed` and `extensionsRequired` of the file.
    pub(in crate::format) extensions_used: Vec<String>,
    pub(in crate::format) extensions_required: Vec<String>,
    /// Length of the JSON text.
    pub(in crate::format) json_bytes: usize,
    /// One per glTF buffer, at least as long as declared.
    pub(super) buffers: Vec<Vec<u8>>,
    /// Folder of the file: images and buffers may lie in it.
    pub(super) folder: PathBuf,
}

/// Extensions without which a file cannot be understood, and which are understood here: the three of our own files, and
/// quantised attributes, which are read like any others.
pub(in crate::format) const UNDERSTOOD: [&str; 4] = [KHR_SPLATS, HYBRID, UNLIT, "KHR_mesh_quantization"];

impl Asset {
    /// Opens a `.glb` or `.gltf` file with all its buffers.
    pub(in crate::format) fn open(path: &Path) -> Result<Self, FormatError> {
        let bytes = read_file(path)?;
        let folder = path.parent().unwrap_or(Path::new("")).to_owned();
        Self::parse(&bytes, folder).map_err(|fault| fault.in_file(path))
    }

    pub(super) fn parse(bytes: &[u8], folder: PathBuf) -> Result<Self, Fault> {
        let (json, json_offset, bin) = if bytes.starts_with(glb::MAGIC) {
            let chunks = glb::split(bytes)?;
            (chunks.json, chunks.json_offset, chunks.bin)
        } else {
            (bytes, 0, None)
        };
        let mut root: Value = serde_json::from_slice(json).map_err(|e| {
            let line_start: usize =
                json.split_inclusive(|&b| b == b'\n').take(e.line().max(1) - 1).map(<[u8]>::len).sum();
            Fault::byte(json_offset + line_start + e.column(), "glTF JSON", e.to_string())
        })?;
        let extensions_used = strings(&root, "extensionsUsed");
        let extensions_required = strings(&root, "extensionsRequired");
        if let Some(unknown) = extensions_required.iter().find(|e| !UNDERSTOOD.contains(&e.as_str())) {
            let expected = format!("no other than {}", UNDERSTOOD.join(", "));
            return Err(Fault::pointer("/extensionsRequired", expected, format!("`{unknown}`")));
        }
        if let Some(object) = root.as_object_mut() {
            object.remove("extensionsRequired");
        }
        let attributes = lift_attributes(&mut root)?;
        let core: gltf::json::Root =
            serde_json::from_value(root).map_err(|e| Fault::whole("glTF 2.0 JSON", e.to_string()))?;
        let document = gltf::Document::from_json(core).map_err(|e| match e {
            gltf::Error::Validation(faults) if !faults.is_empty() => {
                let (path, error) = &faults[0];
                Fault::pointer(rfc6901(path.as_str()), "valid glTF 2.0", error.to_string().to_lowercase())
            }
            other => Fault::whole("valid glTF 2.0", other.to_string()),
        })?;
        let buffers = load_buffers(&document, bin, &folder)?;
        let json_bytes = json.len();
        Ok(Self { document, attributes, extensions_used, extensions_required, json_bytes, buffers, folder })
    }
}

fn strings(root: &Value, key: &str) -> Vec<String> {
    let array = root.get(key).and_then(Value::as_array);
    array.into_iter().flatten().filter_map(|v| v.as_str().map(str::to_owned)).collect()
}

/// `meshes[0].primitives[1]` → `/meshes/0/primitives/1`.
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

/// Leaves only positions and texture coordinates to the core.
fn lift_attributes(root: &mut Value) -> Result<Attributes, Fault> {
    let accessors = root.get("accessors").and_then(Value::as_array).map_or(0, Vec::len);
    let mut lifted = HashMap::new();
    let meshes = root.get_mut("meshes").and_then(Value::as_array_mut).into_iter().flatten();
    for (m, mesh) in meshes.enumerate() {
        let primitives = mesh.get_mut("primitives").and_then(Value::as_array_mut).into_iter().flatten();
        for (p, primitive) in primitives.enumerate() {
            let Some(attributes) = primitive.get_mut("attributes").and_then(Value::as_object_mut) else { continue };
            let mut others = BTreeMap::new();
            for (name, value) in attributes.iter() {
                // The crate indexes with POSITION before it has checked it.
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
    }
    Ok(lifted)
}

fn is_core(name: &str) -> bool {
    name == "POSITION" || name.starts_with("TEXCOORD_")
}

fn load_buffers(document: &gltf::Document, bin: Option<&[u8]>, folder: &Path) -> Result<Vec<Vec<u8>>, Fault> {
    let mut buffers = vec![];
    for (i, buffer) in document.as_json().buffers.iter().enumerate() {
        let at = format!("/buffers/{i}");
        let data = match (&buffer.uri, bin) {
            (None, Some(bin)) if i == 0 => bin.to_vec(),
            (None, _) => return Err(Fault::pointer(at, "a uri or a GLB binary chunk", "neither")),
            (Some(uri), _) => resolve(uri, folder)
                .map_err(|(expected, found)| Fault::pointer(format!("{at}/uri"), expected, found))?,
        };
        if (data.len() as u64) < buffer.byte_length.0 {
            let expected = format!("{} bytes", buffer.byte_length.0);
            return Err(Fault::pointer(format!("{at}/byteLength"), expected, format!("{} bytes", data.len())));
        }
        buffers.push(data);
    }
    Ok(buffers)
}

/// Content of a data URI, or of a file in `folder` or below it. On failure: what was expected, and what was found.
pub(in crate::format) fn resolve(uri: &str, folder: &Path) -> Result<Vec<u8>, (String, String)> {
    if let Some(data) = uri.strip_prefix("data:") {
        let encoded = data.split_once(";base64,").map(|(_, encoded)| encoded);
        return encoded
            .and_then(decode_base64)
            .ok_or_else(|| ("base64 after `;base64,`".to_owned(), "a data URI without it".to_owned()));
    }
    let shown = || format!("`{uri}`");
    let inside = || "a path inside the folder of the file".to_owned();
    let name = percent_decode(uri).ok_or_else(|| ("a percent-encoded path".to_owned(), shown()))?;
    let escapes = name.contains([':', '\\'])
        || Path::new(&name)
            .components()
            .any(|c| !matches!(c, std::path::Component::Normal(_) | std::path::Component::CurDir));
    if escapes {
        return Err((inside(), shown()));
    }
    let real = |path: &Path| path.canonicalize().map_err(|e| ("a readable file".to_owned(), format!("`{name}` ({e})")));
    let base = real(if folder.as_os_str().is_empty() { Path::new(".") } else { folder })?;
    let file = real(&base.join(&name))?;
    // A symbolic link could still lead out.
    if !file.starts_with(&base) {
        return Err((inside(), shown()));
    }
    std::fs::read(&file).map_err(|e| ("a readable file".to_owned(), format!("`{name}` ({e})")))
}

fn percent_decode(uri: &str) -> Option<String> {
    let mut bytes = vec![];
    let mut rest = uri.as_bytes();
    while let Some((&first, tail)) = rest.split_first() {
        rest = tail;
        if first == b'%' {
            let digits = tail.first_chunk::<2>().filter(|d| d.iter().all(u8::is_ascii_hexdigit))?;
            bytes.push(u8::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok()?);
            rest = &tail[2..];
        } else {
            bytes.push(first);
        }
    }
    String::from_utf8(bytes).ok()
}

fn decode_base64(text: &str) -> Option<Vec<u8>> {
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3);
    let (mut bits, mut pending) = (0u32, 0);
    for c in text.trim_end_matches('=').bytes() {
        let value = match c {
            b'A'..=b'Z' => c - b'A',
            b'a'..=b'z' => c - b'a' + 26,
            b'0'..=b'9' => c - b'0' + 52,
            b'+' | b'-' => 62,
            b'/' | b'_' => 63,
            _ => return None,
        };
        bits = (bits << 6 | u32::from(value)) & 0xFF_FFFF;
        pending += 6;
        if pending >= 8 {
            pending -= 8;
            bytes.push((bits >> pending) as u8);
        }
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uris_stay_inside_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let inner = folder.path().join("in");
        std::fs::create_dir(&inner).unwrap();
        std::fs::write(folder.path().join("secret.bin"), b"secret").unwrap();
        std::fs::write(inner.join("a b.bin"), b"ok").unwrap();
        assert_eq!(resolve("a%20b.bin", &inner).unwrap(), b"ok");
        assert_eq!(resolve("./a b.bin", &inner).unwrap(), b"ok");
        for uri in ["../secret.bin", "%2e%2e/secret.bin", "/etc/passwd", "file:///etc/passwd", "..\\secret.bin", "%zz"]
        {
            assert!(resolve(uri, &inner).is_err(), "{uri}");
        }
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(folder.path().join("secret.bin"), inner.join("link.bin")).unwrap();
            let (expected, _) = resolve("link.bin", &inner).unwrap_err();
            assert_eq!(expected, "a path inside the folder of the file");
        }
    }

    #[test]
    fn base64_with_any_padding() {
        for (text, bytes) in [("TWFu", "Man"), ("TWE=", "Ma"), ("TQ==", "M"), ("TQ", "M"), ("", "")] {
            assert_eq!(decode_base64(text).unwrap(), bytes.as_bytes());
        }
        assert!(decode_base64("T*==").is_none());
    }
}
