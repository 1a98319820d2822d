//! Text form of a summary. Names come from the file, with control characters escaped.

use std::borrow::Cow;
use std::fmt;

use super::{CameraSummary, Summary};
use crate::format::error::one_line;
use crate::format::gltf;
use crate::scene::PixelFilter;

/// Most nodes, and most properties of a table, that are printed; `--json` has all.
const MAX_NODES: usize = 100;
const MAX_PROPERTIES: usize = 12;

/// Most consecutive camera nodes that are listed individually.
const FEW_CAMERAS: usize = 3;

/// Number of leading sibling nodes that have a camera, nothing else and no children.
fn cameras(nodes: &[gltf::Node]) -> usize {
    let is_one = |i: usize| {
        let node = &nodes[i];
        let is_leaf = nodes.get(i + 1).is_none_or(|next| next.depth <= node.depth);
        is_leaf && node.depth == nodes[0].depth && node.camera.is_some() && node.mesh.is_none() && node.skin.is_none()
    };
    (0..nodes.len()).take_while(|&i| is_one(i)).count()
}

fn name(name: Option<&str>) -> Cow<'_, str> {
    one_line(name.unwrap_or("(no name)"))
}

fn indent(node: &gltf::Node) -> String {
    "  ".repeat(node.depth.min(20))
}

fn node(f: &mut fmt::Formatter<'_>, node: &gltf::Node) -> fmt::Result {
    write!(f, "\n│ {}• {}", indent(node), name(node.name.as_deref()))?;
    for (what, index) in [("camera", node.camera), ("skin", node.skin), ("mesh", node.mesh)] {
        if let Some(index) = index {
            write!(f, ", {what} {index}")?;
        }
    }
    for p in &node.primitives {
        match (p.triangles, p.sh_degree) {
            (Some(triangles), _) => write!(f, ", {triangles} triangles of {} vertices", p.vertices)?,
            (_, Some(degree)) => {
                write!(f, ", {} splats of degree {degree}{}", p.vertices, if p.is_spz { " (SPZ)" } else { "" })?;
            }
            _ => write!(f, ", {} {}", p.vertices, p.kind)?,
        }
        if p.morph_targets > 0 {
            write!(f, ", {} morph targets", p.morph_targets)?;
        }
    }
    if let Some(bounds) = node.bounds {
        write!(f, ", {}", span(bounds.map(|corner| corner.map(|c| c as f32))))?;
    }
    Ok(())
}

fn tree(f: &mut fmt::Formatter<'_>, document: &gltf::Document) -> fmt::Result {
    let counts: Vec<String> = document.counts.iter().map(|(kind, n)| format!("{n} {kind}")).collect();
    write!(f, "\n├ document: {}", counts.join(", "))?;
    if let Some(generator) = &document.generator {
        write!(f, ", by {}", one_line(generator))?;
    }
    let (mut next, mut lines) = (0, 0);
    while next < document.nodes.len() && lines < MAX_NODES {
        let nodes = &document.nodes[next..];
        let run = cameras(nodes);
        if run > FEW_CAMERAS {
            let [first, last] = [0, run - 1].map(|i| name(nodes[i].name.as_deref()));
            write!(f, "\n│ {}• {run} nodes with cameras: {first} to {last}", indent(&nodes[0]))?;
            next += run;
        } else {
            node(f, &nodes[0])?;
            next += 1;
        }
        lines += 1;
    }
    if next < document.nodes.len() {
        write!(f, "\n│ … and {} more nodes", document.nodes.len() - next)?;
    }
    for clip in &document.animations {
        let (name, [start, end]) = (name(clip.name.as_deref()), clip.range);
        write!(f, "\n├ animation: {name}, {:.3} s", end - start)?;
        if start != 0.0 {
            write!(f, " from {start:.3} s")?;
        }
        write!(f, ", {} channels", clip.channels)?;
    }
    if !document.remainder.is_empty() {
        write!(f, "\n├ beside the scene: {}", one_line(&document.remainder.join(", ")))?;
    }
    Ok(())
}

fn widened(by: PixelFilter) -> String {
    format!("pixel filter {} px²{}", by.variance, if by.normalized { ", normalised (anti-aliased)" } else { "" })
}

fn span([low, high]: [[f32; 3]; 2]) -> String {
    format!("[{:.3} {:.3} {:.3}] to [{:.3} {:.3} {:.3}]", low[0], low[1], low[2], high[0], high[1], high[2])
}

impl fmt::Display for CameraSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let span = |[low, high]: [String; 2]| if low == high { low } else { format!("{low} to {high}") };
        let sizes = span(self.sizes.map(|[w, h]| format!("{w}×{h}")));
        write!(f, "{sizes}, vertical field of view {}", span(self.fov_y.map(|degrees| format!("{degrees:.1}°"))))
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}, {} bytes, {} floats", one_line(&self.file), self.format, self.bytes, self.total_floats)?;
        if let Some(s) = &self.splats {
            write!(f, "\n├ splats: {}, SH degree {}, {}", s.count, s.sh_degree, span(s.bounds))?;
        }
        for m in &self.meshes {
            let [w, h] = m.base_texels;
            write!(f, "\n├ mesh: {} vertices, {} triangles, {}", m.vertices, m.triangles, span(m.bounds))?;
            write!(f, "\n│   maps: {w}×{h}, SH degree {}", m.sh_degree)?;
            if let Some([w, h]) = m.band_texels {
                write!(f, " at {w}×{h}")?;
            }
        }
        if let Some(c) = &self.composition {
            let lambda = c.lambda.map_or("infinite".to_owned(), |l| l.to_string());
            let stated = if c.stated { "" } else { "none stated, shown as " };
            write!(f, "\n├ composition: {stated}{}, λ {lambda}, {} layer(s), {}", c.mode, c.layers, c.color_space)?;
            write!(f, ", near {}, background {:?}", c.near, c.background)?;
            let filter = PixelFilter { variance: c.filter_variance, normalized: c.filter_normalized };
            write!(f, ", {}", widened(filter))?;
        }
        if let Some(filter) = self.pixel_filter {
            write!(f, "\n├ drawn with: {}", widened(filter))?;
        }
        if self.cameras > 0 {
            write!(f, "\n├ cameras: {}", self.cameras)?;
            self.optics.as_ref().map_or(Ok(()), |optics| write!(f, " of {optics}"))?;
        }
        if let Some(document) = &self.document {
            tree(f, document)?;
        }
        for table in &self.tables {
            let (shown, more) = table.properties.split_at(table.properties.len().min(MAX_PROPERTIES));
            write!(f, "\n├ {}: {} rows of {}", one_line(&table.name), table.rows, one_line(&shown.join(", ")))?;
            if !more.is_empty() {
                write!(f, " and {} more", more.len())?;
            }
            if let Some(bounds) = table.bounds {
                write!(f, ", {}", span(bounds))?;
            }
        }
        if !self.extensions_used.is_empty() {
            write!(f, "\n├ extensions: {}", one_line(&self.extensions_used.join(", ")))?;
        }
        if !self.extensions_required.is_empty() {
            write!(f, "\n├ required: {}", one_line(&self.extensions_required.join(", ")))?;
        }
        for warning in &self.warnings {
            write!(f, "\n├ warning: {}", one_line(warning))?;
        }
        let parts: Vec<String> = self.bytes_by_part.iter().map(|(part, bytes)| format!("{part} {bytes}")).collect();
        write!(f, "\n└ bytes: {}", parts.join(", "))
    }
}

#[cfg(test)]
mod tests {
    use super::super::inspect;
    use super::*;
    use crate::format::test_scenes::{camera, random_scene};
    use crate::format::usd;
    use crate::scene::Camera;

    fn written(count: usize, name: impl Fn(usize) -> String, extension: &str) -> Summary {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(format!("a.{extension}"));
        let cameras: Vec<(String, Camera)> = (0..count).map(|i| (name(i), camera())).collect();
        let scene = random_scene(2, 1, 0, 1);
        match extension {
            "glb" => drop(gltf::write_glb(&path, &scene, &cameras, None).unwrap()),
            _ => drop(usd::write(&path, &scene, &cameras, None).unwrap()),
        }
        inspect(&path).unwrap()
    }

    #[test]
    fn many_cameras_are_one_line_and_all_of_them_json() {
        let summary = written(48, |i| format!("{i:03}.jpg"), "glb");
        let text = summary.to_string();
        assert!(text.contains("\n├ cameras: 48 of 640×480, vertical field of view 51.4°\n"), "{text}");
        assert!(text.contains("\n│   • 48 nodes with cameras: 000.jpg to 047.jpg\n"), "{text}");
        assert_eq!(text.matches(".jpg").count(), 2, "{text}");
        let json = serde_json::to_value(&summary).unwrap();
        assert_eq!(json["document"]["nodes"].as_array().unwrap().iter().filter(|n| !n["camera"].is_null()).count(), 48);
        assert_eq!(json["optics"]["sizes"][1], serde_json::json!([640, 480]));
        let text = written(3, |i| format!("{i:03}.jpg"), "glb").to_string();
        assert!(text.contains("\n│   • 001.jpg, camera 1\n"), "few are told one by one: {text}");
        let text = written(48, |i| format!("{i:03}.jpg"), "usda").to_string();
        assert!(text.contains("\n├ cameras: 48 of 640×480, vertical field of view 51.4°\n"), "{text}");
    }

    #[test]
    fn a_composition_that_the_file_does_not_state_is_said_to_be_none() {
        for extension in ["glb", "usda"] {
            let own = written(1, |_| "a".to_owned(), extension).to_string();
            assert!(own.contains("├ composition: ") && !own.contains("none stated"), "{own}");
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.gltf");
        let text = |mesh: &str| {
            let zeros = "A".repeat(48);
            let json = format!(
                r#"{{ "buffers": [{{ "byteLength": 36, "uri": "data:application/octet-stream;base64,{zeros}" }}],
                "bufferViews": [{{ "buffer": 0, "byteLength": 36 }}], "asset": {{ "version": "2.0" }}, "nodes": [{{ {mesh} }}], "scenes": [{{ "nodes": [0] }}], "scene": 0,
                "accessors": [{{ "bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3, "min": [0, 0, 0], "max": [0, 0, 0] }}],
                "meshes": [{{ "primitives": [{{ "attributes": {{ "POSITION": 0 }} }}] }}] }}"#
            );
            std::fs::write(&path, json).unwrap();
            inspect(&path).unwrap().to_string()
        };
        assert!(text(r#""mesh": 0"#).contains("├ composition: none stated, shown as "));
        assert!(!text(r#""name": "empty""#).contains("composition"));
    }

    #[test]
    fn differences_between_cameras_are_told() {
        let optics = CameraSummary { sizes: [[640, 480], [1920, 1080]], fov_y: [40.0, 53.13] };
        assert_eq!(optics.to_string(), "640×480 to 1920×1080, vertical field of view 40.0° to 53.1°");
    }

    #[test]
    fn names_cannot_move_the_cursor() {
        let text = written(2, |i| format!("a\u{1b}[2J\nb{i}"), "glb").to_string();
        assert!(text.contains("• a\\u{1b}[2J\\nb1, camera 1\n"), "{text}");
        let text = written(9, |i| format!("a\rb{i}"), "glb").to_string();
        assert!(text.contains("9 nodes with cameras: a\\rb0 to a\\rb8\n"), "{text}");
        assert!(!text.contains(|c: char| c.is_control() && c != '\n'), "{text}");
    }
}
