//! Writing of splats in the INRIA layout.

use std::io::{self, Write};
use std::ops::Range;

use super::filter::filter_comments;
use super::layout::rest_name;
use crate::format::attribute::Attribute;
use crate::format::blocks::in_waves;
use crate::scene::{PixelFilter, Splats, sh};

/// Number of rows encoded as one task: about 1 MB.
const ROWS: usize = 1 << 12;

/// Writes header and rows. Attributes have as many values as there are splats.
pub(super) fn encode(
    splats: &Splats,
    attributes: &[Attribute],
    pixel_filter: PixelFilter,
    out: &mut (impl Write + Send),
) -> io::Result<()> {
    let (count, comments) = (splats.len(), filter_comments(pixel_filter));
    let properties = properties(splats.sh_degree(), attributes);
    write!(out, "ply\nformat binary_little_endian 1.0\n{comments}element vertex {count}\n{properties}end_header\n")?;
    let block = |i: usize| i * ROWS..count.min((i + 1) * ROWS);
    in_waves(count.div_ceil(ROWS), |i| encode_rows(splats, attributes, block(i)), |rows| out.write_all(&rows))
}

/// Lines of the header that declare the properties of a row.
fn properties(sh_degree: u32, attributes: &[Attribute]) -> String {
    let names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(str::to_owned).into_iter();
    let names = names
        .chain((0..sh::band_floats(sh_degree)).map(rest_name))
        .chain(["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"].map(str::to_owned));
    let names = names.map(|name| ("float", name)).chain(attributes.iter().map(|a| (a.kind.name(), a.name.clone())));
    names.map(|(kind, name)| format!("property {kind} {name}\n")).collect()
}

fn encode_rows(splats: &Splats, attributes: &[Attribute], rows: Range<usize>) -> Vec<u8> {
    let extra: usize = attributes.iter().map(|a| a.kind.bytes()).sum();
    let mut bytes = Vec::with_capacity(rows.len() * (4 * (14 + 3 * sh::coefficients(splats.sh_degree())) + extra));
    for i in rows {
        let mut put = |values: &[f32]| values.iter().for_each(|v| bytes.extend_from_slice(&v.to_le_bytes()));
        let (dc, rest) = (splats.sh_of(i)[0], &splats.sh_of(i)[1..]);
        put(&splats.means()[i].to_array());
        put(&[0.0; 3]);
        put(&dc);
        (0..3).for_each(|channel| rest.iter().for_each(|c| put(&[c[channel]])));
        put(&[splats.opacity_logits()[i]]);
        put(&splats.log_scales()[i].to_array());
        let q = splats.rotations()[i];
        put(&[q.w, q.x, q.y, q.z]);
        attributes.iter().for_each(|a| a.kind.encode(a.values[i], &mut bytes));
    }
    bytes
}
