//! Validation of PLY files of splats.

use std::io::Cursor;

use super::{Findings, Offenders, Severity};
use crate::format::error::Location;
use crate::format::ply::layout::{BINDING, REQUIRED, REST, THICKNESS, is_begun, is_meant, is_parameter, rest_columns};
use crate::format::ply::table::{self, Body, Element, Header, Row};
use crate::format::ply::{compressed, parse_splats};
use crate::scene::sh;

/// Magnitude of logits beyond which opacities in f32 are 0 or 1.
const SATURATED: f64 = 20.0;

/// Number of splats from which on it is no chance if all of them are alike.
const MANY: usize = 100;

/// Checks a PLY in the INRIA layout, or a packed one. Of any other PLY (points, meshes), only the header and the length
/// are checked.
pub(super) fn check(bytes: &[u8], findings: &mut Findings) {
    let (ply, mut body) = match table::open(Cursor::new(bytes)) {
        Ok(ply) => ply,
        Err(fault) => return findings.fault("PLY_HEADER", fault),
    };
    let vertex = match ply.required("vertex") {
        Ok(vertex) => vertex,
        Err(fault) => return findings.fault("PLY_ELEMENT", fault),
    };
    let repeated = ply.repeated_property();
    let is_ambiguous = repeated.is_some();
    repeated.into_iter().for_each(|fault| findings.fault("PLY_PROPERTY_TWICE", fault));
    match body.bytes_after_rows(&ply) {
        Ok(0) => {}
        Ok(rest) => findings.warning("PLY_LENGTH", Location::File, "no bytes after the last row", rest),
        Err(fault) => return findings.fault("PLY_LENGTH", fault),
    }
    if compressed::is_compressed(&ply) {
        // All values are integers between the bounds of their chunk; all other faults are reported by the reader.
        if !is_ambiguous && let Err(fault) = parse_splats(Cursor::new(bytes)) {
            findings.fault("PLY_PACKED", fault);
        }
    } else if has_splats(vertex, findings) {
        check_layout(vertex, findings);
        check_values(&ply, &mut body, findings);
    }
}

/// Whether the table has all that splats need.
fn has_splats(vertex: &Element, findings: &mut Findings) -> bool {
    let declared = Location::Byte(vertex.at as u64);
    if !is_begun(vertex) {
        let expected = "splats in the INRIA or the packed layout";
        findings.warning("PLY_CONTENT", declared, expected, "a PLY of something else");
        return false;
    }
    let missing: Vec<&str> = REQUIRED.into_iter().filter(|name| vertex.scalar(name).is_none()).collect();
    if !missing.is_empty() {
        findings.error("PLY_PROPERTY_MISSING", declared, missing.join(", "), "none of these");
        return false;
    }
    true
}

/// Checks what other readers may not put up with.
fn check_layout(vertex: &Element, findings: &mut Findings) {
    let declared = || Location::Byte(vertex.at as u64);
    if vertex.count == 0 {
        findings.warning("PLY_EMPTY", declared(), "splats", "none: `element vertex 0`");
    }
    if vertex.scalar(THICKNESS).is_none() {
        let expected = "scale_2, the third scale, as other readers demand";
        findings.warning("PLY_FLAT", declared(), expected, "none, as of 2DGS");
    }
    if vertex.scalar(BINDING).is_some() {
        let expected = "positions, rotations and scales in the world";
        let found = format!("`{BINDING}`: relative to triangles of a mesh, as of GaussianAvatars");
        findings.warning("PLY_BINDING", declared(), expected, found);
    }
    let rest = rest_columns(vertex).len();
    match sh::degree_of_band_floats(rest, sh::MAX_DEGREE + 1) {
        Some(degree) if degree > sh::MAX_DEGREE => {
            findings.warning("PLY_SH_COUNT", declared(), "bands up to degree 3, as readers have them", "one more");
        }
        Some(_) => {}
        None => findings.error("PLY_SH_COUNT", declared(), "0, 9, 24 or 45 properties `f_rest_0`, …", rest),
    }
}

fn check_values(ply: &Header, body: &mut Body<Cursor<&[u8]>>, findings: &mut Findings) {
    let Some(mut values) = ply.element("vertex").and_then(Values::of) else { return };
    let walked = body.rows(
        ply,
        "vertex",
        |_| (),
        |(), row| {
            values.look(row);
            Ok(())
        },
    );
    if let Err(fault) = walked {
        findings.fault("PLY_ROWS", fault);
    }
    values.report(findings);
}

/// Values that break a rule, and where in the file the row of the first of them begins.
#[derive(Default)]
struct Placed {
    offenders: Offenders,
    at: usize,
}

impl Placed {
    fn note(&mut self, row: &Row, describe: impl FnOnce() -> String) {
        self.offenders.note(|| {
            self.at = row.at;
            describe()
        });
    }

    /// Place and [`Offenders::summary`].
    fn summary(self, of: usize) -> Option<(Location, String)> {
        Some((Location::Byte(self.at as u64), self.offenders.summary(of)?))
    }
}

/// What was found in the values of rows.
struct Values<'a> {
    vertex: &'a Element,
    /// Column and name of each property.
    names: Vec<(usize, &'a str)>,
    opacity: usize,
    scales: Vec<usize>,
    rotation: [usize; 4],
    rows: usize,
    /// Of each property.
    not_finite: Vec<Placed>,
    zero: Placed,
    unnormalised: Placed,
    linear_opacities: usize,
    linear_scales: usize,
    saturated: usize,
}

impl<'a> Values<'a> {
    /// Values of no rows; `None` if a property is missing.
    fn of(vertex: &'a Element) -> Option<Self> {
        let names = vertex.scalar_names();
        Some(Self {
            vertex,
            not_finite: names.iter().map(|_| Placed::default()).collect(),
            names,
            opacity: vertex.scalar("opacity")?,
            scales: ["scale_0", "scale_1", THICKNESS].iter().filter_map(|name| vertex.scalar(name)).collect(),
            rotation: vertex.scalars(["rot_0", "rot_1", "rot_2", "rot_3"]).ok()?,
            rows: 0,
            zero: Placed::default(),
            unnormalised: Placed::default(),
            linear_opacities: 0,
            linear_scales: 0,
            saturated: 0,
        })
    }

    fn look(&mut self, row: &Row) {
        self.look_for_not_finite(row);
        self.look_at_rotation(row);
        let opacity = row.values[self.opacity];
        self.linear_opacities += usize::from((0.0..=1.0).contains(&opacity));
        self.linear_scales += usize::from(self.scales.iter().all(|&c| row.values[c] >= 0.0));
        self.saturated += usize::from(opacity.abs() > SATURATED);
        self.rows += 1;
    }

    fn look_for_not_finite(&mut self, row: &Row) {
        for ((column, name), found) in self.names.iter().zip(&mut self.not_finite) {
            let v = row.values[*column];
            // Of properties of one name, readers know the first.
            let is_known = || is_meant(name, v) && self.vertex.scalar(name) == Some(*column);
            if !v.is_finite() && !is_known() {
                found.note(row, || format!("{v} in row {} of `{name}`", self.rows));
            }
        }
    }

    fn look_at_rotation(&mut self, row: &Row) {
        let number = self.rows;
        let norm = self.rotation.map(|c| row.values[c] * row.values[c]).iter().sum::<f64>().sqrt();
        if norm == 0.0 {
            self.zero.note(row, || format!("row {number}"));
        } else if (norm - 1.0).abs() > 0.01 {
            self.unnormalised.note(row, || format!("norm {norm:.4} in row {number}"));
        }
    }

    /// Adds to the findings what is wrong with single values, then with all of them.
    fn report(self, findings: &mut Findings) {
        let n = self.rows;
        for ((_, name), found) in self.names.iter().zip(self.not_finite) {
            let Some((at, found)) = found.summary(n) else { continue };
            // PLY allows any number; non-finite values of properties besides parameters, such as normals and labels, do
            // not invalidate the splat. Higher bands are meant to be parameters even if there are too many of them.
            let is_parameter = is_parameter(name) || name.starts_with(REST);
            let severity = if is_parameter { Severity::Error } else { Severity::Warning };
            findings.add(severity, "PLY_NOT_FINITE", at, "finite numbers".to_owned(), found);
        }
        if let Some((at, found)) = self.zero.summary(n) {
            findings.error("PLY_ROTATION_ZERO", at, "quaternions other than 0", found);
        }
        if let Some((at, found)) = self.unnormalised.summary(n) {
            findings.warning("PLY_ROTATION_NORM", at, "unit quaternions (readers normalise them)", found);
        }
        if n >= MANY && self.linear_opacities == n {
            let expected = "opacities as logits, from about -5 to 10";
            findings.warning("PLY_OPACITY_LINEAR", Location::File, expected, "all of them from 0 to 1");
        }
        if n >= MANY && self.linear_scales == n {
            let expected = "scales as natural logarithms, most below 0";
            findings.warning("PLY_SCALE_LINEAR", Location::File, expected, "all of them 0 or more");
        }
        if self.saturated > 0 {
            let expected = format!("logits between -{SATURATED} and {SATURATED}");
            findings.warning(
                "PLY_OPACITY_RANGE",
                Location::File,
                expected,
                format!("{} of {n} beyond", self.saturated),
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::Finding;
    use super::*;
    use crate::format::test_scenes::random_splats;
    use crate::scene::PixelFilter;

    const COLUMNS: usize = 17;

    fn written(n: usize) -> Vec<u8> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s.ply");
        crate::format::ply::write(&path, &random_splats(n, 0, 1)).unwrap();
        std::fs::read(&path).unwrap()
    }

    fn findings(bytes: &[u8]) -> Vec<Finding> {
        let mut findings = Findings::default();
        check(bytes, &mut findings);
        findings.0
    }

    /// Codes found for 200 splats after `change` is applied to each row: x y z, normal, colour, opacity, scales,
    /// rotation.
    fn codes(change: impl Fn(usize, &mut [f32])) -> Vec<(&'static str, Severity)> {
        let mut file = written(200);
        let body = file.len() - 200 * COLUMNS * 4;
        for (i, row) in file[body..].chunks_exact_mut(4 * COLUMNS).enumerate() {
            let mut values: Vec<f32> = row.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
            change(i, &mut values);
            row.as_chunks_mut().0.iter_mut().zip(values).for_each(|(slot, v)| *slot = v.to_le_bytes());
        }
        findings(&file).into_iter().map(|f| (f.code, f.severity)).collect()
    }

    #[test]
    fn what_we_write_is_faultless() {
        assert!(findings(&written(200)).is_empty());
        assert!(matches!(&findings(&written(0))[..], [Finding { code: "PLY_EMPTY", severity: Severity::Warning, .. }]));
    }

    #[test]
    fn values() {
        use Severity::{Error, Warning};
        assert_eq!(
            codes(|i, row| if i == 7 {
                row[1] = f32::NAN;
            }),
            [("PLY_NOT_FINITE", Error)]
        );
        assert_eq!(codes(|_, row| row[11] = f32::INFINITY), [("PLY_NOT_FINITE", Error)]);
        // In a normal, and in other properties by name.
        assert_eq!(codes(|_, row| row[4] = f32::NAN), [("PLY_NOT_FINITE", Warning)]);
        let mut file = written(1);
        let body = file.len() - COLUMNS * 4;
        file[body + 12..][..4].copy_from_slice(&f32::NAN.to_le_bytes());
        let named = |name: &str| {
            let header = std::str::from_utf8(&file[..body]).unwrap().replace(" nx\n", &format!(" {name}\n"));
            let found = findings(&[header.as_bytes(), &file[body..]].concat());
            found.iter().find(|f| f.code == "PLY_NOT_FINITE").map(|f| f.severity)
        };
        assert_eq!(["label", "filter_3D", "f_rest_0"].map(named), [Warning, Error, Error].map(Some));
        assert_eq!(
            codes(|i, row| if i == 7 {
                row[13..].fill(0.0);
            }),
            [("PLY_ROTATION_ZERO", Error)]
        );
        assert_eq!(codes(|_, row| row[13] *= 3.0), [("PLY_ROTATION_NORM", Warning)]);
        assert_eq!(codes(|_, row| row[9] = 0.7), [("PLY_OPACITY_LINEAR", Warning)]);
        assert_eq!(codes(|_, row| row[10..13].fill(0.02)), [("PLY_SCALE_LINEAR", Warning)]);
        assert_eq!(
            codes(|i, row| if i == 7 {
                row[9] = f32::INFINITY;
            }),
            [("PLY_OPACITY_RANGE", Warning)]
        );
        let mut file = written(3);
        let body = file.len() - 3 * COLUMNS * 4;
        file[body + 4 * COLUMNS..][..4].copy_from_slice(&f32::NAN.to_le_bytes());
        let found = &findings(&file)[0];
        assert_eq!(found.found, "1 of 3, the first: NaN in row 1 of `x`");
        assert_eq!(found.location, Location::Byte((body + 4 * COLUMNS) as u64));
    }

    #[test]
    fn infinity_means_something_only_where_readers_look() {
        let mut file = written(1);
        let body = file.len() - COLUMNS * 4;
        file[body + 4 * 9..][..4].copy_from_slice(&f32::INFINITY.to_le_bytes());
        let codes = |name: &str| -> Vec<&'static str> {
            let header = std::str::from_utf8(&file[..body]).unwrap().replace(" nx\n", &format!(" {name}\n"));
            findings(&[header.as_bytes(), &file[body..]].concat()).iter().map(|found| found.code).collect()
        };
        assert_eq!(codes("nx"), ["PLY_OPACITY_RANGE"]);
        // Of two properties of one name it is the first.
        assert_eq!(codes("opacity"), ["PLY_PROPERTY_TWICE", "PLY_NOT_FINITE"]);
    }

    #[test]
    fn headers_and_lengths() {
        let file = written(3);
        let header_end = file.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let header = String::from_utf8(file[..header_end].to_vec()).unwrap();
        let code = |header: &str, body: &[u8]| {
            let found = findings(&[header.as_bytes(), body].concat());
            assert_eq!(found.len(), 1, "{found:?}");
            found[0].code
        };
        let body = &file[header_end..];
        assert_eq!(code("ply\nformat ternary 1.0\n", b""), "PLY_HEADER");
        assert_eq!(code(&header.replace("ian 1.0", "ian 2.0"), body), "PLY_HEADER");
        assert_eq!(code("ply\nformat ascii 1.0\nend_header\n", b""), "PLY_ELEMENT");
        assert_eq!(code(&header, &body[..body.len() - 1]), "PLY_LENGTH");
        assert_eq!(code(&header, &[body, b"more"].concat()), "PLY_LENGTH");
        assert_eq!(code(&header.replace("vertex 3", "vertex 4000000000"), body), "PLY_LENGTH");
        assert_eq!(code(&header.replace("nx", "ny"), body), "PLY_PROPERTY_TWICE");
        assert_eq!(code(&header.replace("rot_2", "rotation_2"), body), "PLY_PROPERTY_MISSING");
        assert_eq!(code(&header.replace("nx", "f_rest_0"), body), "PLY_SH_COUNT");
        // Accepted with a note.
        let put_up_with = |header: &str, body: &[u8], code: &str| {
            let found = findings(&[header.as_bytes(), body].concat());
            assert!(found.len() == 1 && (found[0].code, found[0].severity) == (code, Severity::Warning), "{found:?}");
        };
        put_up_with(&header.replace("scale_2", "thickness"), body, "PLY_FLAT");
        put_up_with(&header.replace("nx", "binding_0"), body, "PLY_BINDING");
        let rest: String = (0..72).map(|i| format!("property float f_rest_{i}\n")).collect();
        let of_degree_4 = header.replace("vertex 3", "vertex 0").replace("end_header", &format!("{rest}end_header"));
        let found = findings(of_degree_4.as_bytes());
        assert_eq!(found.iter().map(|f| f.code).collect::<Vec<_>>(), ["PLY_EMPTY", "PLY_SH_COUNT"]);
        assert!(found.iter().all(|f| f.severity == Severity::Warning), "{found:?}");
        let points = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n";
        assert_eq!(code(points, b"1.0"), "PLY_CONTENT");
        assert_eq!(code(&points.replace("float x", "float opacity"), b"1.0"), "PLY_PROPERTY_MISSING");
        let all = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"];
        let ascii: String = all.iter().map(|n| format!("property float {n}\n")).collect();
        let ascii =
            format!("ply\nformat ascii 1.0\nelement vertex 1\n{ascii}property float rot_0\nproperty float rot_1\n");
        let ascii = format!("{ascii}property float rot_2\nproperty float rot_3\nend_header\n");
        assert!(findings(format!("{ascii}0 0 0 0 0 0 0 0 0 0 1 0 0 0\n\n").as_bytes()).is_empty());
        assert_eq!(code(&ascii, b"0 0 0 0 0 0 nonsense 0 0 0 1 0 0 0"), "PLY_LENGTH");
    }

    #[test]
    fn packed_splats() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s.ply");
        compressed::write(&path, &random_splats(300, 1, 1), PixelFilter::DILATION).unwrap();
        let mut file = std::fs::read(&path).unwrap();
        assert_eq!(findings(&file), []);
        let body = file.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        file[body..body + 4].copy_from_slice(&f32::NAN.to_le_bytes());
        assert_eq!(findings(&file)[0].code, "PLY_PACKED");
    }

    proptest! {
        #[test]
        fn damaged_files_do_not_panic(cut in 0usize..1000, at in 0usize..1000, byte: u8) {
            let mut file = written(3);
            file.truncate(cut.max(1));
            let at = at % file.len();
            file[at] = byte;
            findings(&file);
        }
    }
}
