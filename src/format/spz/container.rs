//! Container of SPZ files: headers, streams, compression, extensions.

use std::io::{self, Read, Write as _};

use flate2::Compression;
use flate2::bufread::GzDecoder;
use flate2::write::GzEncoder;
use rayon::prelude::*;

use super::frame::Frame;
use crate::format::error::Fault;
use crate::scene::sh;

/// Number of streams: means, opacities, SH coefficient 0, scales, rotations, higher bands; in this order in every
/// version.
pub(in crate::format) const STREAMS: usize = 6;
const NAMES: [&str; STREAMS] = ["means", "opacities", "colours", "scales", "rotations", "SH bands"];

const MAGIC: &[u8; 4] = b"NGSP";
const GZIP: [u8; 2] = [0x1f, 0x8b];
const LEGACY_HEADER: usize = 16;
const HEADER: usize = 32;
const TOC_ENTRY: usize = 16;
pub(super) const ANTIALIASED: u8 = 1;
const HAS_EXTENSIONS: u8 = 2;
pub(in crate::format) const KNOWN_FLAGS: u8 = ANTIALIASED | HAS_EXTENSIONS;
/// Extension `SPZ_ADOBE_coordinate_system`.
const COORDINATE_SYSTEM: u32 = 0xADBE_0003;

/// Upper bound on the expansion of compressed data. Deflate cannot exceed it, and no scene of distinct splats comes
/// near it. zstd could expand 30 times as much, so that a short file would fill the memory.
const GREATEST_EXPANSION: u64 = 1032;
/// Size to which any file may expand, however short.
const ALWAYS_PLAUSIBLE: u64 = 64 << 20;
/// Upper bound on bytes kept of what follows the attributes of versions 2 and 3.
const GREATEST_TRAILER: u64 = 1 << 16;
/// zstd's own limit on a decoder's memory, 2²⁷ bytes.
const WINDOW_LOG_MAX: u32 = 27;
/// Compression level: within 1 % of level 12, which the format's own library has used, at a fraction of its time.
const ZSTD_LEVEL: i32 = 9;

/// Header fields common to all versions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::format) struct Header {
    pub(in crate::format) version: u32,
    pub(in crate::format) count: usize,
    /// SH degree, up to 4 in files.
    pub(in crate::format) sh_degree: u32,
    pub(in crate::format) fractional_bits: u8,
    pub(in crate::format) flags: u8,
}

/// File before its splats are decoded. Streams have exactly the lengths required by `header`.
pub(in crate::format) struct Packed {
    pub(in crate::format) header: Header,
    pub(in crate::format) frame: Frame,
    pub(in crate::format) streams: [Vec<u8>; STREAMS],
    pub(in crate::format) notes: Vec<String>,
    /// Number of bytes of the file, or of its unpacked content, that belong to no stream and no extension.
    pub(in crate::format) unused: usize,
}

impl Header {
    /// Bytes of the higher bands of one splat.
    pub(super) fn band_bytes(&self) -> usize {
        sh::band_floats(self.sh_degree)
    }

    fn stream_bytes(&self) -> [u64; STREAMS] {
        let rotation = if self.version == 2 { 3 } else { 4 };
        // Counts are 32 bits in the file, so 64 bits suffice.
        [9, 1, 3, 3, rotation, self.band_bytes() as u64].map(|bytes| bytes * self.count as u64)
    }

    fn parse(bytes: &[u8; LEGACY_HEADER]) -> Result<Self, Fault> {
        let (words, _) = bytes.as_chunks::<4>();
        let word = |k: usize| u32::from_le_bytes(words[k]);
        if words[0] != *MAGIC {
            return Err(Fault::byte(0, "an SPZ header (`NGSP`)", format!("{:02x?}", words[0])));
        }
        let [sh_degree, fractional_bits, flags, _] = words[3];
        let version = word(1);
        if !(2..=4).contains(&version) {
            return Err(Fault::byte(4, "SPZ version 2, 3 or 4", version.to_string()));
        }
        if sh_degree > 4 {
            return Err(Fault::byte(12, "SH degree 0 to 4", sh_degree.to_string()));
        }
        Ok(Self { version, count: word(2) as usize, sh_degree: sh_degree.into(), fractional_bits, flags })
    }

    fn check_plausible(&self, file: usize) -> Result<(), Fault> {
        let needed: u64 = self.stream_bytes().iter().sum();
        let most = ALWAYS_PLAUSIBLE.max(GREATEST_EXPANSION * file as u64);
        if needed <= most {
            return Ok(());
        }
        let expected = format!("at most {most} bytes of splats in a file of {file}");
        Err(Fault::byte(8, expected, format!("{} splats of {needed} bytes", self.count)))
    }
}

/// Splits a file into header, streams and extensions.
pub(in crate::format) fn decode(bytes: &[u8]) -> Result<Packed, Fault> {
    if bytes.starts_with(&GZIP) {
        let mut content = GzDecoder::new(bytes);
        let decoded = decode_legacy(&mut content, bytes.len());
        let decoded = decoded.map(|packed| Packed { unused: packed.unused + content.get_ref().len(), ..packed });
        // Offsets in the header refer to unpacked content; other faults are placed where reading the file stopped.
        return decoded.map_err(|fault| fault.unpacked().or_at_byte(bytes.len() - content.get_ref().len()));
    }
    let Some(start) = bytes.first_chunk::<LEGACY_HEADER>() else {
        return Err(Fault::byte(bytes.len(), format!("an SPZ header of {LEGACY_HEADER} bytes"), "the end of the file"));
    };
    let header = Header::parse(start)?;
    if header.version == 4 {
        return decode_v4(header, bytes);
    }
    let mut rest = bytes;
    decode_legacy(&mut rest, bytes.len()).map_err(|fault| fault.or_at_byte(bytes.len() - rest.len()))
}

fn decode_legacy(content: &mut impl Read, file: usize) -> Result<Packed, Fault> {
    let start = read_exactly(content, LEGACY_HEADER as u64, "header")?;
    // The length is ensured by `read_exactly`.
    let header = Header::parse(start.first_chunk().unwrap_or(&[0; LEGACY_HEADER]))?;
    if header.version == 4 {
        return Err(Fault::byte(4, "version 2 or 3 inside gzip", "4"));
    }
    header.check_plausible(file)?;
    let mut streams = [const { Vec::new() }; STREAMS];
    for ((stream, bytes), name) in streams.iter_mut().zip(header.stream_bytes()).zip(NAMES) {
        *stream = read_exactly(content, bytes, name)?;
    }
    // gzip's checksum is verified only when reading to the very end.
    let mut trailer = vec![];
    content.take(GREATEST_TRAILER).read_to_end(&mut trailer).map_err(|e| damaged("trailer", &e))?;
    io::copy(content, &mut io::sink()).map_err(|e| damaged("trailer", &e))?;
    finish(header, streams, &trailer)
}

fn decode_v4(header: Header, bytes: &[u8]) -> Result<Packed, Fault> {
    let Some(start) = bytes.first_chunk::<HEADER>() else {
        return Err(Fault::byte(bytes.len(), format!("a header of {HEADER} bytes"), "the end of the file"));
    };
    header.check_plausible(bytes.len())?;
    let expected: Vec<(&str, u64)> = NAMES.into_iter().zip(header.stream_bytes()).collect();
    // Most writers leave out empty streams.
    let kept: Vec<usize> = (0..STREAMS).filter(|&k| k + 1 < STREAMS || header.sh_degree > 0).collect();
    let count = usize::from(start[15]);
    if count != kept.len() && count != STREAMS {
        return Err(Fault::byte(15, format!("{} streams", kept.len()), count.to_string()));
    }
    let toc = u32::from_le_bytes(start.as_chunks::<4>().0[4]) as usize;
    let table_end = toc.checked_add(count * TOC_ENTRY).filter(|&end| toc >= HEADER && end <= bytes.len());
    let Some(table_end) = table_end else {
        return Err(Fault::byte(
            16,
            format!("a table of {count} streams within {} bytes", bytes.len()),
            toc.to_string(),
        ));
    };
    let (mut frames, mut offset) = (vec![], table_end);
    for (entry, (name, wanted)) in expected.into_iter().take(count).enumerate() {
        let at = toc + entry * TOC_ENTRY;
        let (sizes, _) = bytes[at..at + TOC_ENTRY].as_chunks::<8>();
        let [compressed, size] = [0, 1].map(|k| u64::from_le_bytes(sizes[k]));
        if size != wanted {
            return Err(Fault::byte(at + 8, format!("{wanted} bytes of {name}"), size.to_string()));
        }
        let end = usize::try_from(compressed).ok().and_then(|c| offset.checked_add(c)).filter(|&e| e <= bytes.len());
        let Some(end) = end else {
            let expected = format!("{name} within the {} bytes left", bytes.len() - offset);
            return Err(Fault::byte(at, expected, format!("{compressed} bytes")));
        };
        frames.push((offset..end, size, name));
        offset = end;
    }
    let decompressed = frames.into_par_iter().map(|(place, size, name)| {
        let at = place.start;
        if size > 0 { decompress(&bytes[place], size, name).map_err(|fault| fault.at_byte(at)) } else { Ok(vec![]) }
    });
    // Report the first fault in file order, regardless of which thread finds one first.
    let decompressed: Vec<Result<Vec<u8>, Fault>> = decompressed.collect();
    let mut streams = [const { Vec::new() }; STREAMS];
    for (stream, content) in streams.iter_mut().zip(decompressed) {
        *stream = content?;
    }
    let packed = finish(header, streams, &bytes[HEADER..toc]).map_err(|fault| fault.or_at_byte(HEADER))?;
    Ok(Packed { unused: packed.unused + bytes.len() - offset, ..packed })
}

fn decompress(frame: &[u8], size: u64, name: &str) -> Result<Vec<u8>, Fault> {
    let failed = |e: io::Error| damaged(name, &e);
    let mut decoder = zstd::stream::read::Decoder::with_buffer(frame).map_err(failed)?;
    decoder.window_log_max(WINDOW_LOG_MAX).map_err(failed)?;
    let stream = read_exactly(&mut decoder, size, name)?;
    let more = decoder.read(&mut [0]).map_err(failed)?;
    if more > 0 {
        return Err(Fault::whole(format!("{size} bytes of {name}"), "more"));
    }
    Ok(stream)
}

/// Reads exactly `size` bytes; memory grows with the bytes that arrive, not with the declared size.
fn read_exactly(content: &mut impl Read, size: u64, name: &str) -> Result<Vec<u8>, Fault> {
    let mut stream = vec![];
    content.take(size).read_to_end(&mut stream).map_err(|e| damaged(name, &e))?;
    if stream.len() as u64 == size {
        return Ok(stream);
    }
    Err(Fault::whole(format!("{size} bytes of {name}"), format!("{} bytes", stream.len())))
}

fn damaged(name: &str, error: &io::Error) -> Fault {
    Fault::whole(format!("{name} that can be decompressed"), error.to_string())
}

/// Completes a file; `extra`: bytes at the place of extensions.
fn finish(header: Header, streams: [Vec<u8>; STREAMS], extra: &[u8]) -> Result<Packed, Fault> {
    let (mut frame, mut notes) = (Frame::default(), vec![]);
    let extensions = if header.flags & HAS_EXTENSIONS == 0 { &[] } else { extra };
    let mut rest = extensions;
    // Records of type, length and content; a truncated last one is ignored, as by the format's own library.
    while let Some((&[a, b, c, d, e, f, g, h], after)) = rest.split_first_chunk::<8>() {
        let (kind, length) = (u32::from_le_bytes([a, b, c, d]), u32::from_le_bytes([e, f, g, h]));
        let Some((content, next)) = after.split_at_checked(length as usize) else { break };
        rest = next;
        match (kind, content.first_chunk().map(|&code| u32::from_le_bytes(code))) {
            (COORDINATE_SYSTEM, Some(code)) => {
                let unknown = || Fault::whole("a coordinate system of 0 to 16", code.to_string());
                frame = Frame::from_code(code).ok_or_else(unknown)?;
            }
            _ => notes.push(format!("the extension {kind:#010x} ({length} bytes) is not known and left out")),
        }
    }
    let unused = extra.len() - (extensions.len() - rest.len());
    Ok(Packed { header, frame, streams, notes, unused })
}

/// Writer that compresses the attributes block by block.
pub(super) struct Writer {
    header: Header,
    streams: Streams,
}

enum Streams {
    /// Attributes are consecutive in a single stream, so all must be complete before the first can be written.
    Legacy([Vec<u8>; STREAMS]),
    V4(Vec<zstd::Encoder<'static, Vec<u8>>>),
}

impl Writer {
    pub(super) fn new(header: &Header) -> io::Result<Self> {
        if u32::try_from(header.count).is_err() {
            return Err(io::Error::other("SPZ holds at most 2^32 splats"));
        }
        let streams = if header.version < 4 {
            Streams::Legacy(header.stream_bytes().map(|bytes| Vec::with_capacity(bytes as usize)))
        } else {
            let kept = if header.sh_degree > 0 { STREAMS } else { STREAMS - 1 };
            let encoder = |&bytes: &u64| {
                let mut encoder = zstd::Encoder::new(vec![], ZSTD_LEVEL)?;
                // The frame then states its size, and small frames get small tables.
                encoder.set_pledged_src_size(Some(bytes))?;
                Ok(encoder)
            };
            Streams::V4(header.stream_bytes()[..kept].iter().map(encoder).collect::<io::Result<_>>()?)
        };
        Ok(Self { header: *header, streams })
    }

    /// Appends the bytes of the next splats.
    pub(super) fn append(&mut self, block: &[Vec<u8>; STREAMS]) -> io::Result<()> {
        match &mut self.streams {
            Streams::Legacy(streams) => streams.iter_mut().zip(block).for_each(|(all, own)| all.extend_from_slice(own)),
            Streams::V4(encoders) => {
                encoders.par_iter_mut().zip(block).try_for_each(|(encoder, own)| encoder.write_all(own))?;
            }
        }
        Ok(())
    }

    pub(super) fn finish(self, out: &mut impl io::Write) -> io::Result<()> {
        let header = self.header;
        let mut start = MAGIC.to_vec();
        start.extend(header.version.to_le_bytes());
        // Checked by `new`.
        start.extend((header.count as u32).to_le_bytes());
        start.extend([header.sh_degree as u8, header.fractional_bits, header.flags]);
        let encoders = match self.streams {
            Streams::Legacy(streams) => {
                start.push(0);
                let mut gzip = GzEncoder::new(out, Compression::default());
                gzip.write_all(&start)?;
                streams.iter().try_for_each(|stream| gzip.write_all(stream))?;
                return gzip.finish().map(drop);
            }
            Streams::V4(encoders) => encoders,
        };
        let frames: Vec<Vec<u8>> = encoders.into_par_iter().map(zstd::Encoder::finish).collect::<io::Result<_>>()?;
        start.push(frames.len() as u8);
        start.extend((HEADER as u32).to_le_bytes());
        start.resize(HEADER, 0);
        for (frame, bytes) in frames.iter().zip(header.stream_bytes()) {
            start.extend((frame.len() as u64).to_le_bytes());
            start.extend(bytes.to_le_bytes());
        }
        out.write_all(&start)?;
        frames.iter().try_for_each(|frame| out.write_all(frame))
    }
}

/// A file of whole streams.
#[cfg(test)]
pub(in crate::format) fn encode(header: &Header, streams: &[Vec<u8>; STREAMS]) -> io::Result<Vec<u8>> {
    let (mut writer, mut file) = (Writer::new(header)?, vec![]);
    writer.append(streams)?;
    writer.finish(&mut file)?;
    Ok(file)
}
