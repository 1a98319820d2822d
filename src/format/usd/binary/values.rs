//! Values of a crate file: 64-bit representations that contain the value or its offset.

use half::f16;

use super::Crate;
use super::compression::integers_64;
use super::cursor::Cursor;
use crate::format::error::Fault;
use crate::format::usd::document::{Entry, Value};

/// Memory of a value in a list or of a time sample besides its numbers or text, in 8-byte numbers: the value itself,
/// its time, and the smallest unit of allocation.
const PER_VALUE: usize = size_of::<(f64, Value)>() / 8 + 4;

/// Shorter arrays are never compressed.
const MIN_COMPRESSED: usize = 16;

/// Bytes of a reference but for its dictionary: indices of a string and of a path, offset and scale of time.
const REFERENCE: usize = 24;

/// Most entries of a dictionary that is skipped; real ones have few.
const MOST_SKIPPED: usize = 1000;

/// Value representation: 1 bit each for array, inlined and compressed, 8 bits of type, 48 bits of content or of its
/// offset.
#[derive(Clone, Copy)]
pub(super) struct Rep(pub(super) u64);

impl Rep {
    fn is_array(self) -> bool {
        self.0 >> 63 == 1
    }

    fn is_inlined(self) -> bool {
        self.0 >> 62 & 1 == 1
    }

    fn is_compressed(self) -> bool {
        self.0 >> 61 & 1 == 1
    }

    fn kind(self) -> u8 {
        (self.0 >> 48) as u8
    }

    fn payload(self) -> u64 {
        self.0 & ((1 << 48) - 1)
    }

    /// Content of at most 32 bits.
    fn inlined(self) -> [u8; 4] {
        (self.0 as u32).to_le_bytes()
    }
}

/// Number type of which rows of a type consist.
#[derive(Clone, Copy)]
enum Number {
    Byte,
    Int,
    Unsigned,
    Int64,
    Half,
    Float,
    Double,
}

impl Number {
    fn bytes(self) -> usize {
        match self {
            Self::Byte => 1,
            Self::Half => 2,
            Self::Int | Self::Unsigned | Self::Float => 4,
            Self::Int64 | Self::Double => 8,
        }
    }
}

/// For a type's number in the file: number type, count per row, and whether the row is a square matrix.
fn numeric(kind: u8) -> Option<(Number, usize, bool)> {
    use Number::{Byte, Double, Float, Half, Int, Int64, Unsigned};
    Some(match kind {
        1 | 2 => (Byte, 1, false),
        3 => (Int, 1, false),
        4 => (Unsigned, 1, false),
        5 | 6 => (Int64, 1, false),
        7 => (Half, 1, false),
        8 => (Float, 1, false),
        9 | 56 => (Double, 1, false),
        13..=15 => (Double, [4, 9, 16][usize::from(kind) - 13], true),
        16..=18 => ([Double, Float, Half][usize::from(kind) - 16], 4, false),
        19..=30 => {
            let index = usize::from(kind) - 19;
            ([Double, Float, Half, Int][index % 4], 2 + index / 4, false)
        }
        _ => return None,
    })
}

impl Crate<'_> {
    /// Reads a value; `None` for types that are not needed here.
    pub(super) fn value(&mut self, rep: Rep) -> Result<Option<Value>, Fault> {
        if let Some((number, width, is_matrix)) = numeric(rep.kind()) {
            if rep.is_array() {
                return self.array(rep, number, width).map(Some);
            }
            if rep.is_inlined() {
                return Ok(Some(inlined(rep.inlined(), number, width, is_matrix)));
            }
            let bytes = self.at(rep.payload())?.take(width * number.bytes())?;
            return Ok(Some(reordered(rep.kind(), values(number, bytes))));
        }
        let index = u32::from_le_bytes(rep.inlined());
        Ok(Some(match (rep.kind(), rep.is_array()) {
            (10..=12, false) => {
                let text = if rep.kind() == 10 { self.string(index)? } else { self.token(index)? };
                self.spend(text.len() / 8)?;
                if rep.kind() == 12 { Value::Asset(text) } else { Value::Text(text) }
            }
            (10..=12, true) if rep.payload() == 0 => Value::List(vec![]),
            (kind @ 10..=12, true) => {
                let mut cursor = self.at(rep.payload())?;
                let count = cursor.array_count(self.version)?;
                let indices = cursor.indices(count)?;
                self.list(&indices, |c, i| match kind {
                    10 => c.string(i).map(Value::Text),
                    11 => c.token(i).map(Value::Text),
                    // Strings in arrays only.
                    _ => c.string(i).map(Value::Asset),
                })?
            }
            (kind @ 32..=34, false) => {
                let indices = self.at(rep.payload())?.list_op()?;
                self.list(&indices, |c, i| match kind {
                    32 => c.token(i).map(Value::Text),
                    33 => c.string(i).map(Value::Text),
                    _ => c.path(i).map(Value::Path),
                })?
            }
            (35, false) => {
                let items = self.at(rep.payload())?.list_op_of(REFERENCE + 8, |cursor| {
                    let item = reference(cursor)?;
                    cursor.take(REFERENCE - 8)?;
                    skip_dictionary(cursor)?;
                    Ok(item)
                })?;
                self.references(&items)?
            }
            // Payloads have no dictionary, and since version 0.8 an offset of time.
            (55, false) => {
                let length = if self.version < [0, 8] { 8 } else { REFERENCE };
                let items = self.at(rep.payload())?.list_op_of(length, |cursor| {
                    let item = reference(cursor)?;
                    cursor.take(length - 8)?;
                    Ok(item)
                })?;
                self.references(&items)?
            }
            (47, false) => {
                let item = reference(&mut self.at(rep.payload())?)?;
                self.references(&[item])?
            }
            (kind @ (41 | 50), false) => {
                let mut cursor = self.at(rep.payload())?;
                let count = cursor.count(4)?;
                let indices = cursor.indices(count)?;
                self.list(&indices, |c, i| match kind {
                    41 => c.token(i).map(Value::Text),
                    _ => c.string(i).map(Value::Text),
                })?
            }
            (45, false) if !rep.is_inlined() => self.selection(rep)?,
            (31, false) => Value::Dictionary(if rep.is_inlined() { vec![] } else { self.entries(rep)? }),
            // Specifier and variability are enumerations.
            (42 | 44, false) => Value::Number(f64::from(rep.inlined()[0])),
            // Of splines only their presence matters.
            (59, _) => Value::List(vec![]),
            (51, _) => Value::Blocked,
            _ => return Ok(None),
        }))
    }

    /// Entries of a dictionary. Only texts get values: others are not needed, and dictionaries could contain
    /// themselves.
    fn entries(&mut self, rep: Rep) -> Result<Vec<Entry>, Fault> {
        let mut cursor = self.at(rep.payload())?;
        // Each entry is an index and an offset, which leads to a value.
        let count = cursor.count(20)?;
        let mut entries = vec![];
        for _ in 0..count {
            let key = u32::from_le_bytes(*cursor.chunk()?);
            cursor.follow()?;
            let value = Rep(cursor.u64()?);
            self.spend(2 * PER_VALUE)?;
            let key = self.string(key)?;
            self.spend(key.len() / 8)?;
            let is_text = (10..=11).contains(&value.kind()) && !value.is_array();
            let (type_name, value) = if is_text { ("string", self.value(value)?) } else { ("", None) };
            entries.push(Entry { type_name: type_name.to_owned(), key, value: value.unwrap_or(Value::Blocked) });
        }
        Ok(entries)
    }

    /// References, given as indices of a string with the other layer, empty for the same, and of a path.
    fn references(&mut self, items: &[[u32; 2]]) -> Result<Value, Fault> {
        let mut values = vec![];
        for &[asset, path] in items {
            let (asset, path) = (self.string(asset)?, self.path(path)?);
            self.spend(PER_VALUE + (asset.len() + path.len()) / 8)?;
            values.push(Value::Reference(asset, path));
        }
        Ok(Value::List(values))
    }

    /// Selected variants: pairs of strings, the names of a set and of its variant.
    fn selection(&mut self, rep: Rep) -> Result<Value, Fault> {
        let mut cursor = self.at(rep.payload())?;
        let mut entries = vec![];
        for _ in 0..cursor.count(8)? {
            let (key, name) = (self.string(cursor.u32()?)?, self.string(cursor.u32()?)?);
            self.spend(2 * PER_VALUE + (key.len() + name.len()) / 8)?;
            entries.push(Entry { type_name: "string".to_owned(), key, value: Value::Text(name) });
        }
        Ok(Value::Dictionary(entries))
    }

    /// Times and values of an animated attribute; for arrays, only the first two.
    pub(super) fn samples(&mut self, rep: Rep) -> Result<Vec<(f64, Value)>, Fault> {
        if rep.kind() != 46 || rep.is_inlined() {
            return Ok(vec![]);
        }
        let mut cursor = self.at(rep.payload())?;
        cursor.follow()?;
        let times = Rep(cursor.u64()?);
        cursor.follow()?;
        let count = cursor.count(8)?;
        // The list of times is a vector (type 48), stored like an array of doubles.
        let mut at_times = self.at(times.payload())?;
        let times = at_times.count(8)?.min(count);
        let mut samples = vec![];
        for i in 0..times {
            let time = f64::from_le_bytes(*at_times.chunk()?);
            let value = Rep(cursor.u64()?);
            // For deforming geometry it suffices to know that it deforms; cameras need all samples.
            if i >= 2 && value.is_array() {
                break;
            }
            self.spend(PER_VALUE + numeric(value.kind()).map_or(0, |(_, width, _)| width))?;
            samples.extend(self.value(value)?.map(|value| (time, value)));
        }
        Ok(samples)
    }

    fn list(&mut self, indices: &[u32], of: impl Fn(&Self, u32) -> Result<Value, Fault>) -> Result<Value, Fault> {
        let mut values = vec![];
        for &index in indices {
            let value = of(self, index)?;
            // Many entries can refer to one long text.
            self.spend(PER_VALUE + value.as_text().map_or(0, str::len) / 8)?;
            values.push(value);
        }
        Ok(Value::List(values))
    }

    fn array(&mut self, rep: Rep, number: Number, width: usize) -> Result<Value, Fault> {
        if rep.payload() == 0 {
            return Ok(values(number, &[]));
        }
        let mut cursor = self.at(rep.payload())?;
        let count = cursor.array_count(self.version)?;
        self.spend(count.saturating_mul(width))?;
        if !rep.is_compressed() || count < MIN_COMPRESSED {
            let length = count.saturating_mul(width * number.bytes());
            return Ok(reordered(rep.kind(), values(number, cursor.take(length)?)));
        }
        let malformed = |c: &Cursor<'_>| c.fault("a compressed array", "something else");
        match number {
            Number::Int => Ok(Value::Integers(cursor.integers(count)?.into_iter().map(i64::from).collect())),
            Number::Unsigned => {
                // Unsigned 32-bit integers.
                let bits = cursor.integers(count)?.into_iter();
                Ok(Value::Integers(bits.map(|v| i64::from(v as u32)).collect()))
            }
            Number::Int64 => {
                let piece = cursor.piece(count)?;
                integers_64(piece, count).map(Value::Integers).ok_or_else(|| malformed(&cursor))
            }
            Number::Byte => Err(malformed(&cursor)),
            Number::Half | Number::Float | Number::Double => {
                let all: Vec<f64> = match cursor.chunk::<1>()? {
                    b"i" => cursor.integers(count)?.into_iter().map(f64::from).collect(),
                    b"t" => {
                        let length = u32::from_le_bytes(*cursor.chunk()?) as usize;
                        let table = values(number, cursor.take(length.saturating_mul(number.bytes()))?);
                        let table = table.as_numbers().unwrap_or_default();
                        let entry = |i: i32| table.get(i as u32 as usize).copied().ok_or_else(|| malformed(&cursor));
                        let indices = cursor.clone().integers(count)?;
                        indices.into_iter().map(entry).collect::<Result<_, _>>()?
                    }
                    _ => return Err(malformed(&cursor)),
                };
                Ok(match number {
                    Number::Double => Value::Doubles(all),
                    _ => Value::Floats(all.into_iter().map(|v| v as f32).collect()),
                })
            }
        }
    }
}

/// Indices of the string and of the path with which a reference or a payload begins.
fn reference(cursor: &mut Cursor<'_>) -> Result<[u32; 2], Fault> {
    Ok([cursor.u32()?, cursor.u32()?])
}

/// Skips a dictionary that is part of another value.
fn skip_dictionary(cursor: &mut Cursor<'_>) -> Result<(), Fault> {
    // Each entry is an index and an offset, which leads to a value and on to the next entry, where the file says: it may
    // lead back, so that the file's length bounds nothing.
    let count = cursor.count(20)?;
    if count > MOST_SKIPPED {
        return Err(Fault::whole(
            format!("dictionaries of at most {MOST_SKIPPED} entries in references"),
            count.to_string(),
        ));
    }
    for _ in 0..count {
        cursor.take(4)?;
        cursor.follow()?;
        cursor.take(8)?;
    }
    Ok(())
}

fn values(number: Number, bytes: &[u8]) -> Value {
    match number {
        Number::Byte => Value::Integers(bytes.iter().map(|&b| i64::from(b)).collect()),
        Number::Int => Value::Integers(rows(bytes).iter().map(|b| i64::from(i32::from_le_bytes(*b))).collect()),
        Number::Unsigned => Value::Integers(rows(bytes).iter().map(|b| i64::from(u32::from_le_bytes(*b))).collect()),
        Number::Int64 => Value::Integers(rows(bytes).iter().map(|b| i64::from_le_bytes(*b)).collect()),
        Number::Half => Value::Floats(rows(bytes).iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect()),
        Number::Float => Value::Floats(rows(bytes).iter().map(|b| f32::from_le_bytes(*b)).collect()),
        Number::Double => Value::Doubles(rows(bytes).iter().map(|b| f64::from_le_bytes(*b)).collect()),
    }
}

fn rows<const N: usize>(bytes: &[u8]) -> &[[u8; N]] {
    bytes.as_chunks().0
}

/// Value inlined in the 32 bits of its representation: doubles as floats, 64-bit integers in 32 bits, vectors and the
/// diagonals of matrices in bytes.
fn inlined(bits: [u8; 4], number: Number, width: usize, is_matrix: bool) -> Value {
    let small = |i: usize| bits.get(i).map_or(0, |&b| i64::from(b as i8));
    let all: Vec<i64> = match (number, width, is_matrix) {
        (Number::Byte | Number::Int | Number::Unsigned | Number::Half | Number::Float, 1, _)
        | (Number::Half, 2, false) => return values(number, &bits[..width * number.bytes()]),
        (Number::Int64, ..) => vec![i64::from(i32::from_le_bytes(bits))],
        (Number::Double, 1, _) => return Value::Doubles(vec![f64::from(f32::from_le_bytes(bits))]),
        (_, _, true) => {
            let side = width.isqrt();
            (0..width).map(|i| if i / side == i % side { small(i / side) } else { 0 }).collect()
        }
        _ => (0..width).map(small).collect(),
    };
    match number {
        Number::Half | Number::Float => Value::Floats(all.into_iter().map(|v| v as f32).collect()),
        Number::Double => Value::Doubles(all.into_iter().map(|v| v as f64).collect()),
        _ => Value::Integers(all),
    }
}

/// Reorders quaternions, which are stored with the real part last, while text and documents have it first.
fn reordered(kind: u8, value: Value) -> Value {
    fn turned<T>(mut all: Vec<T>) -> Vec<T> {
        all.as_chunks_mut::<4>().0.iter_mut().for_each(|q| q.rotate_right(1));
        all
    }
    match value {
        Value::Floats(all) if matches!(kind, 16..=18) => Value::Floats(turned(all)),
        Value::Doubles(all) if matches!(kind, 16..=18) => Value::Doubles(turned(all)),
        value => value,
    }
}
