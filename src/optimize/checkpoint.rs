//! Checkpoints: the state of an optimisation on disk, from which it can resume. A safetensors file with all parameters
//! and moments, and a checksum at its end.

use std::{
    collections::{BTreeMap, HashMap},
    io::{self, Write},
    path::{Path, PathBuf},
};

use flate2::{Crc, CrcWriter};
use safetensors::{
    Dtype, SafeTensorError, SafeTensors,
    tensor::{Metadata, TensorInfo},
};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::{
    atomic,
    render::gpu::state::{GEOMETRY_FLOATS, SplatState},
    scene::{SceneError, sh},
};

/// Version of the layout and of the rules that a run goes on by: written, and the only one that is read. An option that
/// a checkpoint does not hold has its default when a run goes on: a new one, whose default is not what was done before
/// there was one, is such a rule.
pub const VERSION: u32 = 20;

/// Key of [`Header`] in the file's metadata.
const HEADER: &str = "centaur_checkpoint";
/// Name of the last array, one number: the CRC-32 of all bytes before it. Resuming from a flipped bit would be another
/// run, and nothing else would notice.
const CHECKSUM: &str = "checksum";
/// Longest safetensors header that readers of the format accept, bytes.
const MAX_HEADER: usize = 100_000_000;
/// Names of the arrays of [`SplatState`].
const SPLATS: [&str; 6] =
    ["splats/geometry", "splats/sh", "splats/geometry_m", "splats/geometry_v", "splats/sh_m", "splats/sh_v"];

/// Everything that a resumed optimisation needs.
///
/// Arrays survive bit for bit. So do strings and whole numbers up to 64 bits in `meta`; other numbers may be rounded,
/// and the 128-bit state of a generator must be a string.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Checkpoint {
    /// The optimiser's own state: phase, iteration, options, the input of the run …
    pub meta: Value,
    /// The splats with their moments.
    pub splats: SplatState,
    /// Other arrays by name, such as texels and their moments. Names must not be `checksum` or begin with
    /// `splats/`.
    pub tensors: BTreeMap<String, Vec<f32>>,
    /// Integer arrays by name, such as the corners of triangles. Names must differ from those of `tensors`.
    pub indices: BTreeMap<String, Vec<u32>>,
}

/// Why a checkpoint was not written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CheckpointError {
    /// Reading or writing failed.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The content is not valid.
    #[error("{}: {fault}", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// The part at fault, and what is wrong with it.
        fault: SceneError,
    },
}

#[derive(Serialize, Deserialize)]
struct Header {
    version: u32,
    sh_degree: u32,
    meta: Value,
}

/// Error constructor for the checkpoint at `path`, read or about to be written.
fn invalid(path: &Path) -> impl Fn(SceneError) -> CheckpointError {
    |fault| CheckpointError::Invalid { path: path.into(), fault }
}

impl Checkpoint {
    /// Writes to a temporary file in the same folder and renames it to `path`, so that a crash, even of the machine,
    /// leaves the old file.
    ///
    /// # Errors
    /// If the file cannot be written, or would not be accepted by [`Self::read`].
    pub fn write(&self, path: &Path) -> Result<(), CheckpointError> {
        self.validate().map_err(invalid(path))?;
        let header = Header { version: VERSION, sh_degree: self.splats.sh_degree, meta: self.meta.clone() };
        let header = serde_json::to_string(&header)
            .map_err(|e| invalid(path)(SceneError::new("meta", "values that JSON can hold", e.to_string())))?;
        let own = SPLATS.into_iter().zip(self.splats.arrays().map(Array::Floats));
        let others = self.tensors.iter().map(|(name, values)| (name.as_str(), Array::Floats(values)));
        let indices = self.indices.iter().map(|(name, values)| (name.as_str(), Array::Indices(values)));
        // The checksum is known only once everything else is written.
        let arrays: Vec<_> = own.chain(others).chain(indices).chain([(CHECKSUM, Array::Indices(&[0]))]).collect();
        let too_much = |e: String| invalid(path)(SceneError::new("checkpoint", "at most 100 MB of metadata", e));
        let header = described(&arrays, header).map_err(|e| too_much(e.to_string()))?;
        if header.len() > MAX_HEADER {
            return Err(too_much(format!("{} bytes", header.len())));
        }
        // Arrays in the order of their descriptions.
        atomic::write_with(path, |out| {
            let mut out = CrcWriter::new(out);
            out.write_all(&(header.len() as u64).to_le_bytes())?;
            out.write_all(&header)?;
            arrays[..arrays.len() - 1].iter().try_for_each(|(_, array)| array.write(&mut out))?;
            let sum = out.crc().sum();
            Array::Indices(&[sum]).write(&mut out)?;
            // Flushed to disk before it replaces the old file.
            let out = out.into_inner();
            out.flush()?;
            atomic::sync(out.get_ref())
        })
        .map(drop)
        .map_err(|source| CheckpointError::Io { path: path.into(), source })
    }

    /// Reads a file written by [`Self::write`].
    ///
    /// # Errors
    /// If the file cannot be read, is no safetensors file of this version, has the wrong checksum, or has an array that
    /// is missing, of the wrong type or length, or not finite.
    pub fn read(path: &Path) -> Result<Self, CheckpointError> {
        let bytes = std::fs::read(path).map_err(|source| CheckpointError::Io { path: path.into(), source })?;
        Self::from_bytes(&bytes).map_err(invalid(path))
    }

    fn from_bytes(bytes: &[u8]) -> Result<Self, SceneError> {
        check_offsets(bytes)?;
        let file = SafeTensors::deserialize(bytes)
            .map_err(|e| SceneError::new("file", "a safetensors file", e.to_string()))?;
        let (_, metadata) = SafeTensors::read_metadata(bytes)
            .map_err(|e| SceneError::new("file", "a safetensors file", e.to_string()))?;
        let header = metadata.metadata().as_ref().and_then(|m| m.get(HEADER));
        let header = header.ok_or_else(|| SceneError::new("metadata", format!("an entry `{HEADER}`"), "none"))?;
        // The version first: another one may have other fields.
        let header: Value = serde_json::from_str(header).map_err(|e| SceneError::new(HEADER, "JSON", e.to_string()))?;
        let version = header.get("version").unwrap_or(&Value::Null);
        if version.as_u64() != Some(u64::from(VERSION)) {
            let found = format!("{version}: only the version of Centaur that wrote it can continue from it");
            return Err(SceneError::new("version", VERSION.to_string(), found));
        }
        check_sum(bytes)?;
        let header: Header = serde_json::from_value(header)
            .map_err(|e| SceneError::new(HEADER, "version, sh_degree and meta", e.to_string()))?;

        let (mut tensors, mut indices) = (BTreeMap::new(), BTreeMap::new());
        for (name, view) in file.tensors() {
            let (words, _) = view.data().as_chunks::<4>();
            match (view.dtype(), view.shape().len()) {
                (Dtype::F32, 1) => {
                    tensors.insert(name, words.iter().map(|&w| f32::from_le_bytes(w)).collect::<Vec<f32>>());
                }
                (Dtype::U32, 1) => {
                    indices.insert(name, words.iter().map(|&w| u32::from_le_bytes(w)).collect());
                }
                (kind, axes) => {
                    return Err(SceneError::new(name, "f32 or u32 of one axis", format!("{kind:?} of {axes} axes")));
                }
            }
        }
        indices.remove(CHECKSUM);
        let mut take = |name: &str| tensors.remove(name).ok_or_else(|| SceneError::new(name, "an array", "none"));
        let [geometry, sh, geometry_m, geometry_v, sh_m, sh_v] = SPLATS;
        let splats = SplatState {
            sh_degree: header.sh_degree,
            geometry: take(geometry)?,
            sh: take(sh)?,
            geometry_m: take(geometry_m)?,
            geometry_v: take(geometry_v)?,
            sh_m: take(sh_m)?,
            sh_v: take(sh_v)?,
        };
        let checkpoint = Self { meta: header.meta, splats, tensors, indices };
        checkpoint.validate()?;
        Ok(checkpoint)
    }

    fn validate(&self) -> Result<(), SceneError> {
        let s = &self.splats;
        if s.sh_degree > sh::MAX_DEGREE {
            return Err(SceneError::new("sh_degree", "0 to 3", s.sh_degree.to_string()));
        }
        let n = s.geometry.len() / GEOMETRY_FLOATS;
        let (geometry, sh) = (n * GEOMETRY_FLOATS, n * s.sh_floats());
        for ((name, array), expected) in
            SPLATS.into_iter().zip(s.arrays()).zip([geometry, sh, geometry, geometry, sh, sh])
        {
            if array.len() != expected {
                let found = array.len().to_string();
                return Err(SceneError::new(name, format!("{expected} numbers ({n} splats)"), found));
            }
        }
        if let Some((group, splat)) = s.first_non_finite() {
            return Err(SceneError::new(format!("{group} of splat {splat}"), "finite numbers", "another"));
        }
        for name in self.tensors.keys().chain(self.indices.keys()) {
            let is_twice = self.tensors.contains_key(name) && self.indices.contains_key(name);
            if name.starts_with("splats/") || [CHECKSUM, "__metadata__"].contains(&name.as_str()) || is_twice {
                return Err(SceneError::new(name, "an array of another name", "this one"));
            }
        }
        for (name, values) in &self.tensors {
            if let Some(i) = values.iter().position(|v| !v.is_finite()) {
                return Err(SceneError::new(format!("{name}[{i}]"), "a finite number", values[i].to_string()));
            }
        }
        Ok(())
    }
}

/// Checks that no array ends behind the end of the file. `safetensors` checks it too, but adds to the offsets first,
/// which overflows for forged ones.
fn check_offsets(bytes: &[u8]) -> Result<(), SceneError> {
    let no_file = |found: String| SceneError::new("file", "a safetensors file", found);
    let too_short = || no_file(format!("{} byte{}", bytes.len(), if bytes.len() == 1 { "" } else { "s" }));
    let (length, rest) = bytes.split_first_chunk::<8>().ok_or_else(too_short)?;
    let length = u64::from_le_bytes(*length);
    let parts = usize::try_from(length).ok().and_then(|n| rest.split_at_checked(n));
    let (header, arrays) = parts.ok_or_else(|| no_file(format!("a header of {length} bytes in {}", bytes.len())))?;
    let header: BTreeMap<String, Value> = serde_json::from_slice(header).map_err(|e| no_file(e.to_string()))?;
    for (name, tensor) in &header {
        let end = tensor.pointer("/data_offsets/1").and_then(Value::as_u64).unwrap_or(0);
        if end > arrays.len() as u64 {
            let found = format!("only {}: the file is truncated", arrays.len());
            return Err(SceneError::new(name, format!("{end} bytes of arrays"), found));
        }
    }
    Ok(())
}

/// Checks that the last four bytes are the checksum of all others.
fn check_sum(bytes: &[u8]) -> Result<(), SceneError> {
    let (content, stated) = bytes.split_last_chunk().unwrap_or((bytes, &[0; 4]));
    let (mut crc, stated) = (Crc::new(), u32::from_le_bytes(*stated));
    crc.update(content);
    if crc.sum() == stated {
        return Ok(());
    }
    let found = format!("{:08x}: the file is damaged", crc.sum());
    Err(SceneError::new(CHECKSUM, format!("{stated:08x}"), found))
}

/// A one-dimensional tensor of 4-byte words.
#[derive(Clone, Copy)]
enum Array<'a> {
    Floats(&'a [f32]),
    Indices(&'a [u32]),
}

impl<'a> Array<'a> {
    fn words(self) -> &'a [u32] {
        match self {
            Self::Floats(values) => bytemuck::cast_slice(values),
            Self::Indices(values) => values,
        }
    }

    fn write(self, out: &mut impl Write) -> io::Result<()> {
        // The file is little-endian.
        if cfg!(target_endian = "little") {
            return out.write_all(bytemuck::cast_slice(self.words()));
        }
        self.words().iter().try_for_each(|word| out.write_all(&word.to_le_bytes()))
    }
}

/// The header of a safetensors file that holds these arrays one behind the other, padded to eight bytes. `safetensors`
/// itself would need the whole file in memory, or write it under its own name and readable by its owner alone.
fn described(arrays: &[(&str, Array)], header: String) -> Result<Vec<u8>, SafeTensorError> {
    let mut end = 0;
    let infos = arrays.iter().map(|(name, array)| {
        let dtype = if matches!(array, Array::Floats(_)) { Dtype::F32 } else { Dtype::U32 };
        let (start, words) = (end, array.words());
        end += size_of_val(words);
        (String::from(*name), TensorInfo { dtype, shape: vec![words.len()], data_offsets: (start, end) })
    });
    let metadata = Metadata::new(Some(HashMap::from([(HEADER.to_owned(), header)])), infos.collect())?;
    let mut text = serde_json::to_vec(&metadata)?;
    text.resize(text.len().next_multiple_of(8), b' ');
    Ok(text)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;
    use crate::optimize::density::tests::state;

    fn checkpoint() -> Checkpoint {
        let mut splats = state(7, 2);
        splats.geometry[3 * GEOMETRY_FLOATS] = -0.0;
        splats.geometry[4 * GEOMETRY_FLOATS + 1] = f32::MIN_POSITIVE / 8.0; // subnormal
        splats.geometry[5 * GEOMETRY_FLOATS + 2] = 0.1;
        Checkpoint {
            meta: json!({ "iteration": 1200, "seed": u64::MAX, "rng": format!("{:x}", u128::MAX), "options": "c0ffee" }),
            splats,
            tensors: BTreeMap::from([("mesh0/base".into(), vec![1.0, -2.5, f32::MAX]), ("mesh0/bands".into(), vec![])]),
            // Not all of these are exact in f32.
            indices: BTreeMap::from([("mesh0/triangles".into(), vec![0, (1 << 24) + 1, u32::MAX])]),
        }
    }

    fn bytes_of(c: &Checkpoint) -> Vec<u8> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.safetensors");
        c.write(&path).unwrap();
        assert_eq!(folder.path().read_dir().unwrap().count(), 1, "no temporary file stays");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode();
            let plain = folder.path().join("plain");
            std::fs::write(&plain, "").unwrap();
            assert_eq!(mode(&path), mode(&plain), "as readable as any other file");
        }
        std::fs::read(path).unwrap()
    }

    /// Bytes with a valid checksum.
    fn sealed(mut bytes: Vec<u8>) -> Vec<u8> {
        if let Some((content, sum)) = bytes.split_last_chunk_mut::<4>() {
            let mut crc = Crc::new();
            crc.update(content);
            *sum = crc.sum().to_le_bytes();
        }
        bytes
    }

    fn message(bytes: &[u8]) -> String {
        invalid(Path::new("c.safetensors"))(Checkpoint::from_bytes(bytes).unwrap_err()).to_string()
    }

    #[test]
    fn survives_bit_for_bit() {
        let before = checkpoint();
        let bytes = bytes_of(&before);
        let after = Checkpoint::from_bytes(&bytes).ok().unwrap();
        assert_eq!(after, before);
        let bits = |s: &SplatState| s.geometry.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&after.splats), bits(&before.splats), "equality would pass −0 for 0");
        assert_eq!(bytes_of(&after), bytes, "the same file again");
        let empty = Checkpoint::default();
        assert_eq!(Checkpoint::from_bytes(&bytes_of(&empty)).ok().unwrap(), empty);
    }

    #[test]
    fn replaces_an_old_file_and_keeps_it_on_failure() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.safetensors");
        Checkpoint::default().write(&path).unwrap();
        checkpoint().write(&path).unwrap();
        assert_eq!(Checkpoint::read(&path).unwrap(), checkpoint());
        let mut broken = checkpoint();
        broken.splats.geometry[2 * GEOMETRY_FLOATS + 3] = f32::NAN;
        let error = broken.write(&path).unwrap_err();
        assert!(std::error::Error::source(&error).is_none(), "a cause that the message quotes");
        let error = error.to_string();
        assert!(
            error.ends_with("c.safetensors: opacity logits of splat 2: expected finite numbers, found another"),
            "{error}"
        );
        assert_eq!(Checkpoint::read(&path).unwrap(), checkpoint());
        let nowhere = folder.path().join("no folder/c.safetensors");
        assert!(matches!(checkpoint().write(&nowhere), Err(CheckpointError::Io { .. })));
        assert!(matches!(Checkpoint::read(&nowhere), Err(CheckpointError::Io { .. })));
    }

    #[test]
    fn refuses_what_does_not_fit() {
        let broken = |change: fn(&mut Checkpoint)| {
            let mut c = checkpoint();
            change(&mut c);
            c.validate().unwrap_err().field
        };
        assert_eq!(broken(|c| c.splats.sh_degree = 4), "sh_degree");
        assert_eq!(broken(|c| c.splats.sh_degree = 1), "splats/sh");
        assert_eq!(broken(|c| c.splats.geometry.truncate(80)), "splats/geometry");
        assert_eq!(broken(|c| c.splats.sh_v.truncate(80)), "splats/sh_v");
        assert_eq!(broken(|c| c.tensors.get_mut("mesh0/base").unwrap()[1] = f32::NAN), "mesh0/base[1]");
        assert_eq!(broken(|c| drop(c.tensors.insert("splats/sh".into(), vec![]))), "splats/sh");
        assert_eq!(broken(|c| drop(c.indices.insert("mesh0/base".into(), vec![]))), "mesh0/base");
        assert_eq!(broken(|c| drop(c.indices.insert("checksum".into(), vec![]))), "checksum");
    }

    #[test]
    fn says_what_is_wrong_with_a_file() {
        let bytes = bytes_of(&checkpoint());
        let edited = |from: &str, to: &str| {
            assert_eq!(from.len(), to.len());
            let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
            let mut bytes = bytes.clone();
            bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
            message(&sealed(bytes))
        };
        let version = |v: u32| format!(r#"version\":{v}"#);
        // A version with the same number of digits.
        let found = edited(&version(VERSION), &version(VERSION + 1));
        assert!(found.contains(&format!("version: expected {VERSION}, found {}", VERSION + 1)), "{found}");
        assert!(edited("splats/sh_m", "splats/sh_x").contains("splats/sh_m: expected an array, found none"));
        assert!(edited("F32", "I32").contains("expected f32 or u32 of one axis, found I32"));
        assert!(edited("centaur_checkpoint", "somebody_elses_foo").contains("metadata: expected an entry"));
        assert!(message(&bytes[..bytes.len() - 1]).contains("truncated"));
        assert!(message(b"PNG").ends_with("expected a safetensors file, found 3 bytes"));
        assert!(message(b"P").ends_with("expected a safetensors file, found 1 byte"));
    }

    #[test]
    fn every_flipped_bit_is_noticed() {
        let whole = bytes_of(&checkpoint());
        for bit in 0..8 * whole.len() {
            let mut bytes = whole.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(Checkpoint::from_bytes(&bytes).is_err(), "bit {bit}");
        }
        let mut bytes = whole;
        let last_of_arrays = bytes.len() - 5;
        bytes[last_of_arrays] ^= 1;
        let found = message(&bytes);
        assert!(found.contains("checksum: expected ") && found.ends_with(": the file is damaged"), "{found}");
    }

    #[test]
    fn damage_is_told_in_one_line() {
        let whole = bytes_of(&checkpoint());
        let tell = |bytes: &[u8], damage: &str| {
            let found = message(bytes);
            let says_what = found.contains(": expected ") && found.contains(", found ");
            assert!(found.starts_with("c.safetensors: ") && says_what, "{damage}: {found}");
            assert!(found.len() < 600 && !found.contains('\n'), "{damage}: {found}");
        };
        for part in 0..16 {
            tell(&whole[..whole.len() * part / 16], &format!("cut to {part}/16"));
        }
        let header = 8 + u64::from_le_bytes(*whole.first_chunk().unwrap()) as usize;
        for at in 0..header {
            let mut bytes = whole.clone();
            bytes[at] ^= 1;
            tell(&bytes, &format!("another byte {at}"));
        }
    }

    #[test]
    fn offsets_near_overflow_are_an_error() {
        let size = (u64::MAX / 32) * 4;
        let tensors: Vec<String> = (0..8)
            .map(|i| {
                let (start, end) = (i * size, (i + 1) * size);
                format!(r#""t{i}":{{"dtype":"F32","shape":[{}],"data_offsets":[{start},{end}]}}"#, size / 4)
            })
            .collect();
        let header = format!("{{{}}}", tensors.join(","));
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend(header.bytes());
        assert!(message(&bytes).contains("truncated"));
    }

    proptest! {
        #[test]
        fn damaged_files_are_errors_not_panics(
            cut in any::<prop::sample::Index>(),
            flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..4),
        ) {
            let bytes = bytes_of(&checkpoint());
            prop_assert!(Checkpoint::from_bytes(&bytes[..cut.index(bytes.len())]).is_err());
            let mut bytes = bytes;
            for (at, value) in flips {
                let at = at.index(bytes.len());
                bytes[at] = value;
            }
            if let Ok(c) = Checkpoint::from_bytes(&sealed(bytes)) {
                prop_assert!(c.splats.first_non_finite().is_none());
            }
        }

        #[test]
        fn random_bytes_are_no_checkpoint(bytes in prop::collection::vec(any::<u8>(), 0..400), text in "\\PC{0,200}") {
            prop_assert!(Checkpoint::from_bytes(&bytes).is_err());
            let mut framed = (text.len() as u64).to_le_bytes().to_vec();
            framed.extend(text.bytes());
            prop_assert!(Checkpoint::from_bytes(&framed).is_err());
        }
    }
}
