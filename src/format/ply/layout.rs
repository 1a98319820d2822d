//! Properties of INRIA's splats: their names, where they are in a row, and what their values mean.

use glam::{Quat, Vec3};

use super::table::{Column, Element};
use crate::format::activation;
use crate::format::error::Fault;
use crate::format::splat_record::SplatRecord;
use crate::scene::{sh, smoothed_parameters};

/// Properties of every splat, except for the third scale, which flat splats lack.
pub(in crate::format) const REQUIRED: [&str; 13] =
    ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3"];

/// Third scale, which files of 2DGS lack.
pub(in crate::format) const THICKNESS: &str = "scale_2";

/// Thickness assigned to splats without one.
const FLAT: f32 = 1e-6;

/// Property of Mip-Splatting with the standard deviation of a splat's 3D smoothing filter; scale and opacity in the
/// file are those before smoothing.
pub(super) const FILTER_3D: &str = "filter_3D";

/// Start of the names of higher SH bands: `f_rest_0`, `f_rest_1`, …
pub(in crate::format) const REST: &str = "f_rest_";

/// Property of `GaussianAvatars` with the triangle of a FLAME mesh that a splat follows.
pub(in crate::format) const BINDING: &str = "binding_0";

/// What positions of bound splats are.
const BOUND: &str = "from GaussianAvatars: positions, rotations and scales are relative to triangles of a mesh that is not in this file, and are read unchanged";

/// Normals, which carry no information of splats.
pub(super) const NORMALS: [&str; 3] = ["nx", "ny", "nz"];

/// Whether the property `name` is a parameter of splats. Those of higher SH bands are not considered.
pub(in crate::format) fn is_parameter(name: &str) -> bool {
    REQUIRED.contains(&name) || [THICKNESS, FILTER_3D].contains(&name)
}

/// Whether a value that is not finite means something: a logit of ±∞ is an opacity of 0 or 1, a log-scale of −∞ a scale
/// of 0.
pub(in crate::format) fn is_meant(name: &str, value: f64) -> bool {
    match name {
        "opacity" => value.is_infinite(),
        "scale_0" | "scale_1" | THICKNESS => value == f64::NEG_INFINITY,
        _ => false,
    }
}

/// Whether a table has anything of splats in this layout.
pub(in crate::format) fn is_begun(vertex: &Element) -> bool {
    ["f_dc_0", "opacity", "scale_0", "rot_0"].iter().any(|name| vertex.scalar(name).is_some())
}

/// Name of coefficient `i` of the higher SH bands, channel by channel.
pub(super) fn rest_name(i: usize) -> String {
    format!("{REST}{i}")
}

/// Columns of `f_rest_0`, `f_rest_1`, …
pub(in crate::format) fn rest_columns(element: &Element) -> Vec<Column> {
    // Beyond twice the largest accepted number, the exact number does not matter.
    (0..90).map_while(|i| element.column(&rest_name(i))).collect()
}

/// SH degree with `rest` coefficients above the zeroth, in three channels; one degree more than a scene can hold is
/// recognised.
pub(super) fn degree_of_rest(rest: usize) -> Result<u32, Fault> {
    sh::degree_of_band_floats(rest, sh::MAX_DEGREE + 1)
        .ok_or_else(|| Fault::whole("0, 9, 24, 45 or 72 `f_rest` properties", rest.to_string()))
}

/// Where the parameters of a splat are in a row.
pub(super) struct Layout {
    mean: [Column; 3],
    dc: [Column; 3],
    /// SH bands above the zeroth, channel-major.
    rest: Vec<Column>,
    /// SH degree in the file.
    stored_degree: u32,
    opacity: Column,
    scales: [Column; 2],
    thickness: Option<Column>,
    wxyz: [Column; 4],
    filter: Option<Column>,
}

impl Layout {
    pub(super) fn of(vertex: &Element) -> Result<Self, Fault> {
        let [x, y, z, red, green, blue, opacity, first, second, qw, qx, qy, qz] = vertex.columns(REQUIRED)?;
        let rest = rest_columns(vertex);
        let stored_degree = degree_of_rest(rest.len()).map_err(|fault| fault.at_byte(vertex.at))?;
        Ok(Self {
            mean: [x, y, z],
            dc: [red, green, blue],
            rest,
            stored_degree,
            opacity,
            scales: [first, second],
            thickness: vertex.column(THICKNESS),
            wxyz: [qw, qx, qy, qz],
            filter: vertex.column(FILTER_3D),
        })
    }

    /// SH degree of what is read.
    pub(super) fn sh_degree(&self) -> u32 {
        self.stored_degree.min(sh::MAX_DEGREE)
    }

    /// Whether splats are made of the property `name`.
    pub(super) fn reads(&self, name: &str) -> bool {
        is_parameter(name) || name.starts_with(REST) && (0..self.rest.len()).any(|i| name == rest_name(i))
    }

    /// Notes on what is unlike INRIA's layout in a table of this one.
    pub(super) fn notes(&self, vertex: &Element) -> Vec<String> {
        let (kept, stored) = (self.sh_degree(), self.stored_degree);
        let is_bound = vertex.scalar(BINDING).is_some();
        let notes = [
            (vertex.count == 0).then(|| "holds no splats: `element vertex 0`".to_owned()),
            self.thickness
                .is_none()
                .then(|| format!("{THICKNESS} is missing, as in files of 2DGS: splats are flat, {FLAT:e} thick")),
            is_bound.then(|| format!("{BINDING}: {BOUND}")),
            (kept < stored).then(|| format!("SH bands above degree {kept} of {stored} are left out")),
            self.filter.map(|_| format!("{FILTER_3D} of Mip-Splatting: made part of scales and opacities")),
        ];
        notes.into_iter().flatten().collect()
    }

    /// Decodes the splat of a row.
    pub(super) fn decode(&self, row: &[u8]) -> SplatRecord {
        let v = |column: Column| column.f32(row);
        let [w, x, y, z] = self.wxyz.map(v);
        let [first, second] = self.scales.map(v);
        let log_scale = Vec3::new(first, second, self.thickness.map_or(FLAT.ln(), v)).map(finite_log_scale);
        let deviation = self.filter.map_or(0.0, |column| v(column).abs());
        let (log_scale, opacity_logit) = smoothed_parameters(log_scale, finite_logit(v(self.opacity)), deviation);
        SplatRecord {
            mean: Vec3::from(self.mean.map(v)),
            rotation: Quat::from_xyzw(x, y, z, w),
            log_scale,
            opacity_logit,
            sh_degree: self.sh_degree(),
            sh: self.sh(row),
        }
    }

    fn sh(&self, row: &[u8]) -> [[f32; 3]; 16] {
        let v = |column: Column| column.f32(row);
        let bands = self.rest.len() / 3;
        let mut sh = [[0.0; 3]; 16];
        sh[0] = self.dc.map(v);
        for (coefficient, band) in sh[1..].iter_mut().zip(0..bands) {
            *coefficient = [0, 1, 2].map(|channel| v(self.rest[channel * bands + band]));
        }
        sh
    }
}

fn finite_logit(logit: f32) -> f32 {
    if logit.is_infinite() { activation::logit(if logit > 0.0 { 1.0 } else { 0.0 }).0 } else { logit }
}

fn finite_log_scale(log_scale: f32) -> f32 {
    if log_scale == f32::NEG_INFINITY { activation::log_scale(0.0).0 } else { log_scale }
}
