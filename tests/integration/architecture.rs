//! The invariants of ARCHITECTURE.md, checked in the source text: which module may import which, in which directories
//! imports are acyclic, and what the library must not do.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Modules of the library, and our modules that each may import.
const MAY_IMPORT: [(&str, &[&str]); 13] = [
    ("atomic", &[]),
    ("base64", &[]),
    ("scene", &[]),
    ("stats", &[]),
    ("capture", &["atomic", "scene", "format", "stats"]),
    ("edit", &["scene"]),
    ("format", &["atomic", "base64", "scene"]),
    ("geometry", &["scene", "stats"]),
    ("metrics", &["base64", "scene"]),
    ("path", &["scene", "stats"]),
    ("render", &["scene", "geometry", "stats"]),
    ("evaluate", &["scene", "capture", "metrics", "render"]),
    ("optimize", &["atomic", "scene", "capture", "edit", "evaluate", "geometry", "render", "stats"]),
];

/// Directories below `src` in which no file imports one that imports it, be it by way of others. What a directory holds
/// besides, and what the file above it has of its own, counts for all.
const ONE_WAY: [&str; 24] = [
    "capture",
    "cli",
    "cli/bench",
    "edit",
    "format",
    "format/gltf",
    "format/ply",
    "format/sog",
    "format/spz",
    "format/usd",
    "format/usd/binary",
    "format/validate",
    "format/validate/gltf",
    "geometry",
    "metrics",
    "optimize",
    "optimize/density",
    "optimize/static_scene",
    "path",
    "render",
    "render/gpu",
    "render/gpu/device",
    "render/reference",
    "scene",
];

/// Text that may occur only in some files: (text, path prefixes, description).
const ONLY_IN: [(&str, &[&str], &str); 9] = [
    ("wgpu::", &["render/gpu/device/"], "wgpu outside render/gpu/device"),
    ("print!", &["cli/", "main.rs"], "printing in the library"),
    ("println!", &["cli/", "main.rs"], "printing in the library"),
    ("process::exit", &["cli/", "main.rs"], "a process exit in the library"),
    // Dependencies of the feature `cli`.
    ("anyhow::", &["cli/", "main.rs"], "anyhow in the library"),
    ("clap::", &["cli/", "main.rs"], "clap in the library"),
    ("ctrlc::", &["cli/", "main.rs"], "ctrlc in the library"),
    ("indicatif::", &["cli/", "main.rs"], "indicatif in the library"),
    ("signal_hook::", &["cli/", "main.rs"], "signal-hook in the library"),
];

/// Source without comments and without test items, whose last line is indented like their first.
fn production(text: &str) -> String {
    let indentation = |line: &str| line.len() - line.trim_start().len();
    let mut kept = String::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        if line.trim() == "#[cfg(test)]" {
            let is_last = |next: &&str| {
                let is_attribute = next.trim_start().starts_with("#[");
                indentation(next) == indentation(line) && next.trim_end().ends_with(['}', ';', ',']) && !is_attribute
            };
            lines.find(is_last);
            continue;
        }
        kept.push_str(line.split("//").next().unwrap());
        kept.push('\n');
    }
    kept
}

fn is_test_file(path: &Path) -> bool {
    let stem = path.file_stem().unwrap().to_str().unwrap();
    let in_tests = path.components().any(|part| part.as_os_str() == "tests");
    in_tests || matches!(stem, "tests" | "testing" | "test_scenes") || stem.ends_with("_tests")
}

fn identifier(text: &str) -> &str {
    &text[..text.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(text.len())]
}

/// First segments of the path at the beginning of `text`: one, or those of a group in braces.
fn heads(text: &str) -> Vec<&str> {
    let text = text.trim_start();
    let Some(group) = text.strip_prefix('{') else { return vec![identifier(text)] };
    let (mut depth, mut starts, mut found) = (0, true, vec![]);
    for (i, c) in group.char_indices() {
        match c {
            '{' => depth += 1,
            '}' if depth == 0 => break,
            '}' => depth -= 1,
            ',' if depth == 0 => starts = true,
            _ if starts && c.is_alphabetic() => {
                found.push(identifier(&group[i..]));
                starts = false;
            }
            _ => {}
        }
    }
    found
}

/// Items of `module` that `text`, a file at `path` below it, imports by the module's name or by enough `super::`.
fn imports<'a>(module: &str, path: &Path, text: &'a str) -> Vec<&'a str> {
    let named = if path.ends_with("mod.rs") { 1 } else { 0 };
    let up = "super::".repeat(path.components().count() - named);
    let mut found = vec![];
    for way in [format!("{module}::"), up] {
        found.extend(text.match_indices(&way).flat_map(|(i, _)| heads(&text[i + way.len()..])));
    }
    found
}

/// Names that the file above a directory re-exports from the directory's files, and from which.
fn taken_over(above: &str) -> BTreeMap<&str, &str> {
    let mut from = BTreeMap::new();
    for (i, _) in above.match_indices("use ") {
        let before = above[..i].rsplit('\n').next().unwrap();
        if !matches!(before, "" | "pub " | "pub(crate) " | "pub(super) ") {
            continue;
        }
        let used = above[i + 4..].split(';').next().unwrap();
        let words = used.split(|c: char| !c.is_alphanumeric() && c != '_');
        let mut words = words.filter(|word| !matches!(*word, "" | "self"));
        let module = words.next().unwrap();
        from.extend(words.map(|name| (name, module)));
    }
    from
}

/// Imports among files of a directory that are part of a cycle, or that connect two cycles, by file. `files` are (path
/// in the directory, text), and `above` is the text of the file above it.
fn circles(directory: &str, above: &str, files: &[(PathBuf, String)]) -> Vec<String> {
    let module_of = |path: &Path| identifier(path.iter().next().unwrap().to_str().unwrap()).to_owned();
    let taken_over = taken_over(above);
    let mut names = directory.rsplit('/');
    // A crate has the same name as two of the directories, where the parent directory is named as well.
    let name = match names.next().unwrap() {
        "gltf" => format!("{}::gltf", names.next().unwrap()),
        name => name.to_owned(),
    };
    let mut graph: BTreeMap<String, BTreeSet<String>> =
        files.iter().map(|(path, _)| (module_of(path), BTreeSet::new())).collect();
    for (path, text) in files {
        let module = module_of(path);
        let found: Vec<&str> = imports(&name, path, text).iter().map(|n| *taken_over.get(n).unwrap_or(n)).collect();
        let siblings = found.iter().filter(|other| **other != module && graph.contains_key(**other));
        let siblings: Vec<String> = siblings.map(|other| (*other).to_owned()).collect();
        graph.get_mut(&module).unwrap().extend(siblings);
    }
    // A file that imports none of the remaining files, or is imported by none of them, is in no cycle.
    loop {
        let imported: BTreeSet<String> = graph.values().flatten().cloned().collect();
        let before = graph.len();
        graph.retain(|module, of| !of.is_empty() && imported.contains(module));
        let left: BTreeSet<String> = graph.keys().cloned().collect();
        graph.values_mut().for_each(|of| of.retain(|other| left.contains(other)));
        if graph.len() == before {
            break;
        }
    }
    graph.iter().map(|(module, of)| format!("{directory}: {module} imports {of:?}")).collect()
}

/// Violations in a file at `path` below `src`.
fn violations(path: &Path, text: &str) -> Vec<String> {
    if is_test_file(path) {
        return vec![];
    }
    let (shown, text) = (path.display(), production(text));
    let module = identifier(path.iter().next().unwrap().to_str().unwrap());
    let mut wrong = vec![];
    if let Some((_, allowed)) = MAY_IMPORT.iter().find(|(name, _)| *name == module) {
        for import in imports("crate", path, &text) {
            let is_module = MAY_IMPORT.iter().any(|(name, _)| *name == import);
            if is_module && import != module && !allowed.contains(&import) {
                wrong.push(format!("{shown}: {module} imports {import}"));
            }
        }
    }
    for (word, places, what) in ONLY_IN {
        if text.contains(word) && !places.iter().any(|place| shown.to_string().starts_with(place)) {
            wrong.push(format!("{shown}: {what}"));
        }
    }
    wrong
}

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
}

#[test]
fn source_keeps_the_invariants() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = vec![];
    sources(&root, &mut files);
    files.sort();
    let wrong: Vec<String> = files
        .iter()
        .flat_map(|file| violations(file.strip_prefix(&root).unwrap(), &std::fs::read_to_string(file).unwrap()))
        .collect();
    assert!(files.len() > 50, "found only {} files", files.len());
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn imports_go_one_way() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let read = |path: &Path| production(&std::fs::read_to_string(path).unwrap());
    for directory in ONE_WAY {
        let (folder, mut files) = (root.join(directory), vec![]);
        sources(&folder, &mut files);
        let above =
            [folder.join("mod.rs"), folder.with_extension("rs")].into_iter().find(|file| file.exists()).unwrap();
        files.retain(|file| *file != above && !is_test_file(file));
        let files: Vec<(PathBuf, String)> =
            files.iter().map(|file| (file.strip_prefix(&folder).unwrap().into(), read(file))).collect();
        assert!(files.len() > 1, "{directory}: found only {} files", files.len());
        let wrong = circles(directory, &read(&above), &files);
        assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    }
}

#[test]
fn every_module_has_a_rule() {
    let lib = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("src/lib.rs")).unwrap();
    let mut modules: Vec<&str> =
        lib.lines().filter_map(|l| l.trim_start_matches("pub ").strip_prefix("mod ")?.strip_suffix(';')).collect();
    let mut ruled = MAY_IMPORT.map(|(name, _)| name).to_vec();
    modules.sort_unstable();
    ruled.sort_unstable();
    assert_eq!(modules, ruled);
}

/// A file that is not declared as a module is not compiled, and its tests would silently not run.
#[test]
fn every_file_beside_this_one_is_compiled() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/integration");
    let main = std::fs::read_to_string(folder.join("main.rs")).unwrap();
    let declared: BTreeSet<&str> =
        main.lines().filter_map(|line| line.strip_prefix("mod ")?.strip_suffix(';')).collect();
    let mut files = vec![];
    sources(&folder, &mut files);
    let files: Vec<&str> = files.iter().map(|file| file.file_stem().unwrap().to_str().unwrap()).collect();
    assert_eq!(declared, files.into_iter().filter(|name| *name != "main").collect());
}

#[test]
fn violations_are_found_and_tests_exempt() {
    let check = |path: &str, text: &str| violations(Path::new(path), text);
    assert_eq!(check("scene/mesh.rs", "use crate::format::ply;"), ["scene/mesh.rs: scene imports format"]);
    assert_eq!(check("edit/mod.rs", "use super::{scene, format::x};"), ["edit/mod.rs: edit imports format"]);
    assert!(check("capture/mod.rs", "use super::{scene, format::x};").is_empty());
    assert!(check("optimize/static_scene/tests/a.rs", "eprintln!(\"a\");").is_empty());
    assert_eq!(check("format/ply/mod.rs", "use super::super::render;"), ["format/ply/mod.rs: format imports render"]);
    let group = "use crate::{scene::{Mesh, Splats}, capture::{open, View},\n optimize};";
    assert_eq!(check("render/gpu/a.rs", group).len(), 2);
    assert_eq!(check("metrics/psnr.rs", "fn f(x: &crate::render::Image) {}").len(), 1);
    assert_eq!(
        check("render/gpu/blend.rs", "x: wgpu::Buffer"),
        ["render/gpu/blend.rs: wgpu outside render/gpu/device"]
    );
    assert_eq!(check("format/mod.rs", "eprintln!(\"a\"); std::process::exit(1);").len(), 2);
    assert_eq!(check("optimize/mod.rs", "#[derive(clap::Args)]").len(), 1);

    let fine = "use super::format::x; // crate::format\nuse crate::scene;\n#[cfg(test)]\nmod tests;\n";
    assert!(check("geometry/bvh.rs", fine).is_empty());
    assert!(check("geometry/bvh.rs", "#[cfg(test)]\nmod tests {\n use crate::capture;\n}").is_empty());
    assert_eq!(check("geometry/bvh.rs", "#[cfg(test)]\nmod tests;\nuse crate::capture;").len(), 1);
    // Code after a test item is checked, however long the item is.
    let test_only = "impl A {\n    #[cfg(test)]\n    #[must_use]\n    fn f(\n        x: crate::capture::View,\n    ) -> u32 {\n        1\n    }\n    fn g(x: crate::optimize::Run) {}\n}";
    assert_eq!(check("geometry/bvh.rs", test_only), ["geometry/bvh.rs: geometry imports optimize"]);
    assert!(check("render/gpu/device/mod.rs", "wgpu::Device").is_empty());
    assert!(check("cli/eval.rs", "println!()").is_empty());
}

#[test]
fn circles_are_found() {
    let check = |above: &str, files: &[(&str, &str)]| {
        let files: Vec<(PathBuf, String)> = files.iter().map(|(path, text)| (path.into(), production(text))).collect();
        circles("render/gpu", above, &files)
    };
    let above = "mod a;\nmod b;\npub use a::{A, of as a_of};\npub(crate) use self::b::B;\nuse crate::scene::C;\nfn f() { \"use c, A\"; }";
    let one_way = ("a.rs", "use super::{f, C, B};\nuse crate::a::x;");
    let tests = "use super::f;\n#[cfg(test)]\nmod tests {\n use super::super::A;\n}";
    assert!(check(above, &[one_way, ("b.rs", tests)]).is_empty());
    let circle = ["render/gpu: a imports {\"b\"}", "render/gpu: b imports {\"a\"}"];
    for back in ["use super::A;", "use super::{f, a::{x, y}};", "use crate::{scene::C, render::gpu::{a_of, f}};"] {
        assert_eq!(check(above, &[one_way, ("b.rs", back), ("c.rs", "use super::{a, b};")]), circle, "{back}");
    }
    // Through a third file, and through a directory, whose files count as one with the file above them.
    let third = [one_way, ("b/deep.rs", "use super::super::c::x;\nuse super::a::x;"), ("c.rs", "use super::a;")];
    assert_eq!(check(above, &third).len(), 3);
    assert!(check(above, &[one_way, ("b.rs", "use super::c;"), ("b/a.rs", "use super::a;"), ("c.rs", "")]).is_empty());
    // A crate is not one of our directories.
    for (named, found) in [("gltf::Node", 0), ("crate::format::gltf::Node", 2)] {
        let files =
            [("transform.rs", format!("fn f(x: {named}) {{}}")), ("tree.rs", "use super::transform;".to_owned())];
        let files = files.map(|(path, text)| (PathBuf::from(path), text));
        assert_eq!(circles("format/gltf", "pub use tree::Node;", &files).len(), found, "{named}");
    }
}
