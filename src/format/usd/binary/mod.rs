//! Reader of the binary form of a layer (`.usdc`, "crate"), versions 0.4 and later, which gives the same document as
//! text.
//!
//! A table of contents names six sections: tokens, strings (indices of tokens), fields (a name and a value), sets of
//! fields, paths as a tree, and specs, each a path with a set of fields. Values may be anywhere in the file.

mod compression;
mod cursor;
#[cfg(test)]
mod tests;
mod tree;
mod values;

use compression::decompress;
use cursor::Cursor;
use values::Rep;

use super::document::Layer;
use crate::format::error::Fault;

/// Signature at the start of a file.
pub(in crate::format::usd) const MAGIC: &[u8] = b"PXR-USDC";

/// Memory budget, in 8-byte numbers, for the tables and all values of a file of this length. A compressed array of
/// equal numbers takes a thousandth of its budget in the file, but no real file consists of those: the barest prim
/// takes 8 bytes of the file, and one with forty properties shared with all others takes one byte per property.
fn most_values(bytes: usize) -> usize {
    (1 << 16) + bytes.saturating_mul(64)
}

/// Bytes of the shortest text: the smallest unit of allocation.
const LEAST_TEXT: usize = 32;

/// End marker of a set of fields.
const END: u32 = u32::MAX;

/// Opened file.
struct Crate<'a> {
    file: &'a [u8],
    version: [u8; 2],
    /// Offset of the section with the places of values.
    fields_at: usize,
    tokens: Vec<String>,
    /// Strings, as indices of tokens.
    strings: Vec<u32>,
    /// Fields: name and value.
    fields: Vec<(u32, Rep)>,
    /// Sets of field indices, terminated by [`END`].
    sets: Vec<u32>,
    paths: Vec<PathNode>,
    /// Remaining memory budget for tables and values, in 8-byte numbers.
    budget: usize,
}

/// Path, represented by its last element.
#[derive(Clone, Copy, Default)]
struct PathNode {
    /// Index of the parent path; the root is its own parent.
    parent: usize,
    token: u32,
    is_property: bool,
    depth: usize,
}

/// Parses the bytes of a layer.
pub(super) fn parse(file: &[u8]) -> Result<Layer, Fault> {
    let mut header = Cursor::new(file, MAGIC.len() as u64)?;
    let [major, minor, ..] = *header.chunk::<8>()?;
    let version = [major, minor];
    if !([0, 4]..[1, 0]).contains(&version) {
        return Err(Fault::byte(MAGIC.len(), "a crate file of version 0.4 to 0.x", format!("{major}.{minor}")));
    }
    let contents = header.u64()?;
    Cursor::new(file, contents).map_err(|fault| fault.or_at_byte(MAGIC.len() + 8))?;
    let mut sections = Sections { file, contents };
    let tokens = sections.open("TOKENS")?;
    let tokens_at = tokens.at();
    let fields = sections.open("FIELDS")?;
    let mut of = Crate {
        file,
        version,
        fields_at: fields.at(),
        tokens: vec![],
        strings: vec![],
        fields: vec![],
        sets: vec![],
        paths: vec![],
        budget: most_values(file.len()),
    };
    of.tokens = of.read_tokens(tokens).map_err(|fault| fault.or_at_byte(tokens_at))?;
    let mut strings = sections.open("STRINGS")?;
    let count = strings.count(4)?;
    of.strings = strings.indices(count)?;
    of.fields = of.read_fields(fields)?;
    let mut sets = sections.open("FIELDSETS")?;
    let count = of.counted(&mut sets, size_of::<u32>())?;
    of.sets = sets.integers(count)?.into_iter().map(|i| i as u32).collect();
    let paths = sections.open("PATHS")?;
    let paths_at = paths.at();
    of.paths = of.read_paths(paths).map_err(|fault| fault.or_at_byte(paths_at))?;
    let mut specs = sections.open("SPECS")?;
    let specs_at = specs.at();
    let count = of.counted(&mut specs, size_of::<[i32; 3]>())?;
    let [paths, sets, kinds] = [specs.integers(count)?, specs.integers(count)?, specs.integers(count)?];
    of.layer(&paths, &sets, &kinds).map_err(|fault| fault.or_at_byte(specs_at))
}

struct Sections<'a> {
    file: &'a [u8],
    contents: u64,
}

impl<'a> Sections<'a> {
    fn open(&mut self, name: &str) -> Result<Cursor<'a>, Fault> {
        let mut contents = Cursor::new(self.file, self.contents)?;
        for _ in 0..contents.count(32)? {
            let label = contents.chunk::<16>()?;
            let start = contents.u64()?;
            contents.u64()?;
            if label.starts_with(name.as_bytes()) && label[name.len()] == 0 {
                return Cursor::new(self.file, start).map_err(|fault| fault.or_at_byte(contents.at() - 16));
            }
        }
        Err(contents.fault(format!("a section {name}"), "none of this name"))
    }
}

impl<'a> Crate<'a> {
    fn read_tokens(&mut self, mut section: Cursor<'_>) -> Result<Vec<String>, Fault> {
        let count = self.counted(&mut section, size_of::<String>() + LEAST_TEXT)?;
        let length = section.u64()?;
        let size = section.count(1)?;
        let malformed = || Fault::whole("a section TOKENS of zero-ended UTF-8", "something else");
        let length = usize::try_from(length).map_err(|_| malformed())?;
        let text = decompress(section.take(size)?, length).ok_or_else(malformed)?;
        self.spend(text.len() / 8)?;
        let text = String::from_utf8(text).map_err(|_| malformed())?;
        let tokens: Vec<String> = text.split_terminator('\0').take(count + 1).map(str::to_owned).collect();
        if tokens.len() != count {
            return Err(Fault::whole(format!("{count} tokens"), tokens.len().to_string()));
        }
        Ok(tokens)
    }

    fn read_fields(&mut self, mut section: Cursor<'_>) -> Result<Vec<(u32, Rep)>, Fault> {
        let count = self.counted(&mut section, size_of::<(u32, Rep)>())?;
        let names = section.integers(count)?;
        let size = section.count(1)?;
        let reps = decompress(section.take(size)?, count.saturating_mul(8)).unwrap_or_default();
        let reps = reps.as_chunks::<8>().0;
        if reps.len() != count {
            return Err(section.fault(format!("{count} compressed values"), reps.len().to_string()));
        }
        Ok(names.into_iter().zip(reps).map(|(name, rep)| (name as u32, Rep(u64::from_le_bytes(*rep)))).collect())
    }

    /// Reads a count of possibly compressed elements, each of which takes `bytes` bytes of memory, and reserves these.
    fn counted(&mut self, cursor: &mut Cursor<'_>, bytes: usize) -> Result<usize, Fault> {
        let (count, most) = (cursor.u64()?, self.budget.saturating_mul(8) / bytes);
        let Some(fitting) = usize::try_from(count).ok().filter(|&c| c <= most) else {
            return Err(cursor.fault(format!("a count of {most} or less"), count.to_string()));
        };
        self.budget -= fitting * bytes / 8;
        Ok(fitting)
    }

    fn at(&self, offset: u64) -> Result<Cursor<'a>, Fault> {
        Cursor::new(self.file, offset)
    }

    /// Reserves memory from the budget. Many fields can refer to one long array or text.
    fn spend(&mut self, numbers: usize) -> Result<(), Fault> {
        self.budget = self.left_after(numbers)?;
        Ok(())
    }

    fn left_after(&self, numbers: usize) -> Result<usize, Fault> {
        let too_many = || Fault::whole(format!("at most {} values", most_values(self.file.len())), "more");
        self.budget.checked_sub(numbers).ok_or_else(too_many)
    }

    fn token(&self, index: u32) -> Result<String, Fault> {
        self.tokens.get(index as usize).cloned().ok_or_else(|| self.no_token(index))
    }

    fn no_token(&self, index: u32) -> Fault {
        Fault::whole(format!("tokens below {}", self.tokens.len()), index.to_string())
    }

    /// Copies a token as a name and reserves its memory: many objects can share one long name.
    fn name(&mut self, token: u32) -> Result<String, Fault> {
        self.spend(1 + self.tokens.get(token as usize).map_or(0, String::len) / 8)?;
        self.token(token)
    }

    fn string(&self, index: u32) -> Result<String, Fault> {
        let outside = || Fault::whole(format!("strings below {}", self.strings.len()), index.to_string());
        self.token(*self.strings.get(index as usize).ok_or_else(outside)?)
    }

    /// Path as text, `/prim.property`, if the budget allows it.
    fn path(&self, index: u32) -> Result<String, Fault> {
        let outside = || Fault::whole(format!("paths below {}", self.paths.len()), index.to_string());
        let mut node = self.paths.get(index as usize).ok_or_else(outside)?;
        let (mut parts, mut length) = (vec![], 0);
        while node.depth > 0 {
            let name = self.tokens.get(node.token as usize).ok_or_else(|| self.no_token(node.token))?;
            parts.push([if node.is_property { "." } else { "/" }, name]);
            length += 1 + name.len();
            node = self.paths.get(node.parent).ok_or_else(outside)?;
        }
        self.left_after(length / 8)?;
        parts.reverse();
        Ok(parts.as_flattened().concat())
    }
}
