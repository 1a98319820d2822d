//! Shader text: the embedded WGSL files and the small preprocessor that specialises them.
//!
//! Directives are comment lines, so that a file stays close to plain WGSL:
//! * `//#import shared/x.wgsl [with NAME=value …]` inserts a file; `$NAME` in it becomes `value`.
//! * `//#if NAME`, `//#if !NAME` or `//#if A<B`, `//#else`, `//#end`: keep lines if that holds (a define holds if not
//!   0).
//! * `//#for i in A..B` … `//#end`: repeats lines with `$i` replaced by A, …, B−1; if A > B, by A−1, …, B.
//!   A and B are numbers or defines.
//!
//! Every define is also emitted as `const NAME`, of u32 or f32; so are the constants of [`view`], the numbers of
//! [`contract`] and those of sums in fixed point.

use std::collections::BTreeMap;

use super::view;
use crate::render::contract;

macro_rules! embed {
    ($($(#[$when:meta])* $name:literal),* $(,)?) => {
        const FILES: &[(&str, &str)] =
            &[$($(#[$when])* ($name, include_str!(concat!("../../../shaders/", $name)))),*];
    };
}

embed![
    "adam_splats.wgsl",
    "adam_texels.wgsl",
    "bin_triangles.wgsl",
    "blend_backward.wgsl",
    "blend_depth.wgsl",
    "blend_forward.wgsl",
    "blend_layers.wgsl",
    "blend_rays.wgsl",
    "build_mips.wgsl",
    "ceilings.wgsl",
    "check_lists.wgsl",
    "compact_visible.wgsl",
    "count_passes.wgsl",
    "dispatch_sizes.wgsl",
    "emit_pairs.wgsl",
    "exposure.wgsl",
    "filter_splats.wgsl",
    "gather_counts.wgsl",
    "gather_rows.wgsl",
    "gradient_peak.wgsl",
    "loss.wgsl",
    "loss_serial.wgsl",
    "move_vertices.wgsl",
    "order_splats.wgsl",
    "pose.wgsl",
    "project_rays.wgsl",
    "project_splats.wgsl",
    "radix_sort.wgsl",
    "radix_sort_serial.wgsl",
    "raster_layers.wgsl",
    "scan.wgsl",
    "setup_triangles.wgsl",
    "shade_layers.wgsl",
    "shared/adam.wgsl",
    "shared/adam_of_view.wgsl",
    "shared/batch.wgsl",
    "shared/blend.wgsl",
    "shared/finite.wgsl",
    "shared/fixed_add.wgsl",
    "shared/fixed_point.wgsl",
    "shared/fragment_gradient.wgsl",
    "shared/group_index.wgsl",
    "shared/layered.wgsl",
    "shared/loss_terms.wgsl",
    "shared/map.wgsl",
    "shared/mesh_fragment.wgsl",
    "shared/move_up.wgsl",
    "shared/pair_gradient.wgsl",
    "shared/projection.wgsl",
    "shared/radiance.wgsl",
    "shared/random.wgsl",
    "shared/rotation.wgsl",
    "shared/saturating_add.wgsl",
    "shared/sh.wgsl",
    "shared/sh_coefficients.wgsl",
    "shared/sh_gradient.wgsl",
    "shared/sort_pass.wgsl",
    "shared/splats_at_pixels.wgsl",
    "shared/spread.wgsl",
    "shared/status.wgsl",
    "shared/sum_rows.wgsl",
    "shared/tile_bucket.wgsl",
    "shared/tile_depths.wgsl",
    "shared/tile_rows.wgsl",
    "shared/view.wgsl",
    "shared/window.wgsl",
    "shared/workgroup_scan.wgsl",
    "splat_backward.wgsl",
    "sum_pairs.wgsl",
    #[cfg(test)]
    "tests/spread.wgsl",
    "texel_backward.wgsl",
    "texel_backward_serial.wgsl",
    "tile_ranges.wgsl",
    "uv_backward.wgsl",
    "vertex_backward.wgsl",
];

/// Numbers shared by kernels and the reference, under the same names in both.
const CONTRACT: [(&str, f64); 6] = [
    ("ALPHA_CAP", contract::ALPHA_CAP),
    ("ALPHA_CUT", contract::ALPHA_CUT),
    ("JACOBIAN_MARGIN", contract::JACOBIAN_MARGIN),
    ("MESH_ALPHA_CAP", contract::MESH_ALPHA_CAP),
    ("TIE_EPSILON", contract::TIE_EPSILON),
    ("TRANSMITTANCE_STOP", contract::TRANSMITTANCE_STOP),
];

/// Units of fixed point that the largest gradient of a fragment is; `shaders/shared/fixed_point.wgsl` says why so many.
pub(crate) const FIXED_ONE: f32 = 1_048_576.0;
/// What a unit of the higher bands is, in those of the base map.
pub(crate) const BAND_UNIT: f32 = 8.0;
/// Pixels of a texel of the base map up to which its sum has room several times over: each layer and each chart that
/// lies on the same texel adds its own. A fragment is crowded if its texel has more.
pub(crate) const CROWD: f32 = 1024.0;
/// The same of a texel of the higher bands.
const BAND_CROWD: f32 = 2048.0;

/// Numbers of sums in fixed point, by the names that kernels have for them.
const FIXED_POINT: [(&str, f32); 4] =
    [("FIXED_ONE", FIXED_ONE), ("BAND_UNIT", BAND_UNIT), ("CROWD", CROWD), ("BAND_CROWD", BAND_CROWD)];

/// Names and values that specialise a shader.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub(crate) struct Defines {
    whole: BTreeMap<&'static str, u32>,
    /// The bits of an f32.
    real: BTreeMap<&'static str, u32>,
}

impl Defines {
    /// The same defines with one more.
    pub(crate) fn with(mut self, name: &'static str, value: u32) -> Self {
        self.whole.insert(name, value);
        self
    }

    /// The same defines with a real number, which directives cannot test.
    pub(crate) fn with_real(mut self, name: &'static str, value: f64) -> Self {
        self.real.insert(name, (value as f32).to_bits());
        self
    }

    fn value(&self, text: &str) -> u32 {
        let name = text.trim();
        let value = name.parse().ok().or_else(|| self.whole.get(name).copied());
        value.unwrap_or_else(|| panic!("shader define {name} is not set"))
    }

    fn holds(&self, condition: &str) -> bool {
        if let Some((a, b)) = condition.split_once('<') {
            return self.value(a) < self.value(b);
        }
        match condition.trim().strip_prefix('!') {
            Some(name) => self.value(name) == 0,
            None => self.value(condition) != 0,
        }
    }
}

/// The complete WGSL of `file` for these defines. Panics on a malformed shader file, as these are part of the program.
pub(crate) fn preprocess(file: &str, defines: &Defines) -> String {
    let mut out = String::new();
    for (name, value) in CONTRACT.map(|(name, value)| (name, value as f32)).into_iter().chain(FIXED_POINT) {
        out.push_str(&format!("const {name}: f32 = {value:?};\n"));
    }
    for (name, value) in view::CONSTANTS.iter().map(|(name, value)| (name, value)).chain(&defines.whole) {
        out.push_str(&format!("const {name}: u32 = {value}u;\n"));
    }
    for (name, bits) in &defines.real {
        out.push_str(&format!("const {name}: f32 = {:?};\n", f32::from_bits(*bits)));
    }
    let text = load(file);
    let lines: Vec<&str> = text.lines().collect();
    expand(&lines, defines, &mut out);
    out
}

fn load(file: &str) -> &'static str {
    let found = FILES.iter().find(|(name, _)| *name == file);
    found.unwrap_or_else(|| panic!("shader {file} is not embedded")).1
}

fn expand(lines: &[&str], defines: &Defines, out: &mut String) {
    let mut i = 0;
    while i < lines.len() {
        let Some(directive) = lines[i].trim_start().strip_prefix("//#") else {
            out.push_str(lines[i]);
            out.push('\n');
            i += 1;
            continue;
        };
        if let Some(import) = directive.strip_prefix("import ") {
            let (file, arguments) = import.split_once(" with ").unwrap_or((import, ""));
            let mut text = load(file.trim()).to_owned();
            for pair in arguments.split_whitespace() {
                let (name, value) = pair.split_once('=').expect("NAME=value after 'with'");
                text = text.replace(&format!("${name}"), value);
            }
            expand(&text.lines().collect::<Vec<_>>(), defines, out);
            i += 1;
            continue;
        }
        let (body, otherwise, next) = block(lines, i);
        if let Some(condition) = directive.strip_prefix("if ") {
            expand(if defines.holds(condition) { body } else { otherwise }, defines, out);
        } else if let Some(range) = directive.strip_prefix("for ") {
            let (name, range) = range.split_once(" in ").expect("'for i in A..B'");
            let (from, to) = range.split_once("..").expect("'A..B'");
            let (from, to) = (defines.value(from), defines.value(to));
            let values: Vec<u32> = if from <= to { (from..to).collect() } else { (to..from).rev().collect() };
            for value in values {
                let text = body.join("\n").replace(&format!("${}", name.trim()), &value.to_string());
                expand(&text.lines().collect::<Vec<_>>(), defines, out);
            }
        } else {
            panic!("unknown shader directive {directive}");
        }
        i = next;
    }
}

/// Body, else-body and the line after the block that starts at `start`.
fn block<'a>(lines: &'a [&'a str], start: usize) -> (&'a [&'a str], &'a [&'a str], usize) {
    let (mut depth, mut middle) = (0, None);
    for (i, line) in lines.iter().enumerate().skip(start) {
        match line.trim_start().strip_prefix("//#").map(str::trim) {
            Some(d) if d.starts_with("if ") || d.starts_with("for ") => depth += 1,
            Some("else") if depth == 1 => middle = Some(i),
            Some("end") if depth == 1 => {
                let end_of_body = middle.unwrap_or(i);
                let otherwise = middle.map_or(&lines[i..i], |m| &lines[m + 1..i]);
                return (&lines[start + 1..end_of_body], otherwise, i + 1);
            }
            Some("end") => depth -= 1,
            _ => {}
        }
    }
    panic!("shader block without //#end: {}", lines[start]);
}

/// Kind of access of a shader to a binding of group 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Access {
    Uniform,
    Read,
    ReadWrite,
}

/// The bindings of group 0 in a preprocessed shader, in order of their numbers.
pub(crate) fn bindings(wgsl: &str) -> Vec<(u32, Access)> {
    let mut found = Vec::new();
    for line in wgsl.lines() {
        let Some(rest) = line.trim_start().strip_prefix("@group(0) @binding(") else { continue };
        let (number, rest) = rest.split_once(')').expect("a closing bracket");
        let access = match rest {
            r if r.contains("var<uniform>") => Access::Uniform,
            r if r.contains("read_write") => Access::ReadWrite,
            _ => Access::Read,
        };
        found.push((number.parse().expect("a binding number"), access));
    }
    found.sort_by_key(|b| b.0);
    found
}

/// Workgroup size of an entry point of a preprocessed shader.
pub(crate) fn workgroup_size(wgsl: &str, entry: &str, defines: &Defines) -> u32 {
    let (before, _) = wgsl.split_once(&format!("fn {entry}(")).expect("the entry point");
    let (_, size) = before.rsplit_once("@workgroup_size(").expect("a size before it");
    defines.value(size.split_once(')').expect("a closing bracket").0)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    /// A shader missing in the list would otherwise be noticed only when a kernel uses it.
    #[test]
    fn every_shader_is_embedded() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("shaders");
        let mut files = vec![];
        for prefix in ["", "shared/", "tests/"] {
            let folder = folder.join(prefix);
            let names = folder.read_dir().unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
            files.extend(names.filter(|name| name.ends_with(".wgsl")).map(|name| format!("{prefix}{name}")));
        }
        files.sort();
        assert_eq!(files, FILES.iter().map(|(name, _)| *name).collect::<Vec<_>>());
    }

    #[test]
    fn blocks_nest_and_loops_substitute() {
        let defines = Defines::default().with("N", 3).with("OFF", 0);
        let source = "//#for i in 0..N\na$i\n//#if OFF\nx\n//#else\ny$i\n//#end\n//#end\nz";
        let mut out = String::new();
        expand(&source.lines().collect::<Vec<_>>(), &defines, &mut out);
        assert_eq!(out, "a0\ny0\na1\ny1\na2\ny2\nz\n");
        out.clear();
        expand(&["//#for i in N..0", "//#if $i<2", "$i", "//#end", "//#end"], &defines, &mut out);
        assert_eq!(out, "1\n0\n");
    }

    #[test]
    fn bindings_are_found() {
        let wgsl = "@group(0) @binding(1) var<storage, read> a: array<f32>;\n@group(0) @binding(0) var<uniform> v: V;";
        assert_eq!(bindings(wgsl), vec![(0, Access::Uniform), (1, Access::Read)]);
    }

    #[test]
    fn workgroups_are_measured() {
        let wgsl = "@compute @workgroup_size(8)\nfn a() {}\n@compute @workgroup_size(N)\nfn b(\n) {}";
        assert_eq!(["a", "b"].map(|entry| workgroup_size(wgsl, entry, &Defines::default().with("N", 64))), [8, 64]);
    }
}
