//! Comparison of the extension's text with its schemas.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde_json::Value;

use super::super::binding::geometry_digest;
use super::super::schema;
use super::{Findings, HYBRID, KHR};

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("schema/EXT_gaussian_splatting_hybrid")
}

fn readme() -> String {
    std::fs::read_to_string(folder().join("README.md")).unwrap()
}

/// Properties of an object, with whether each is required.
type Properties = BTreeMap<String, bool>;

/// The tables of properties, by the schema linked last in the text above each.
fn tables(text: &str) -> BTreeMap<String, Properties> {
    let mut tables = BTreeMap::new();
    let (mut schema, mut inside) = (String::new(), false);
    for line in text.lines() {
        if let Some((_, link)) = line.split_once("(schema/") {
            schema = link.split_once(')').unwrap().0.to_owned();
        }
        inside = line == "| Property | Type | Description | Required |" || inside && line.starts_with('|');
        let Some(name) = line.strip_prefix("| `").filter(|_| inside) else { continue };
        let properties: &mut Properties = tables.entry(schema.clone()).or_default();
        let is_new = properties.insert(name.split_once('`').unwrap().0.to_owned(), line.ends_with("| ✓ |")).is_none();
        assert!(is_new, "{line}");
    }
    tables
}

fn schemas() -> BTreeMap<String, Value> {
    let read = |path: PathBuf| {
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        (name, serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap())
    };
    folder().join("schema").read_dir().unwrap().map(|entry| read(entry.unwrap().path())).collect()
}

#[test]
fn every_property_stands_in_the_text_and_in_its_schema() {
    let text = readme();
    let (tables, schemas) = (tables(&text), schemas());
    let of_schema = |schema: &Value| -> Properties {
        let required = schema["required"].as_array().cloned().unwrap_or_default();
        let names = schema["properties"].as_object().unwrap().keys();
        let own = names.filter(|name| !["extensions", "extras"].contains(&name.as_str()));
        own.map(|name| (name.clone(), required.iter().any(|r| r == name))).collect()
    };
    let described: BTreeMap<String, Properties> = schemas.iter().map(|(n, s)| (n.clone(), of_schema(s))).collect();
    assert_eq!(tables, described);
}

#[test]
fn defaults_and_choices_of_the_schemas_stand_in_the_text() {
    let text = readme();
    let mut checked = 0;
    for (file, schema) in schemas() {
        for (name, property) in schema["properties"].as_object().unwrap() {
            let is_row = |line: &&str| line.starts_with(&format!("| `{name}` |"));
            let rows: Vec<&str> = text.lines().filter(is_row).collect();
            let says = |words: &str| assert!(rows.iter().any(|row| row.contains(words)), "{file} {name}: {words}");
            for choice in property["anyOf"].as_array().into_iter().flatten().filter_map(|c| c["const"].as_str()) {
                says(&format!("`{choice}`"));
                checked += 1;
            }
            match &property["default"] {
                Value::Null => {}
                Value::String(word) => says(&format!("Default: `{word}`")),
                Value::Array(numbers) => {
                    let numbers: Vec<String> = numbers.iter().map(Value::to_string).collect();
                    says(&format!("Default: `[{}]`", numbers.join(", ")));
                }
                number => says(&format!("Default: {number}")),
            }
        }
    }
    assert_eq!(checked, 20);
}

#[test]
fn links_lead_somewhere() {
    let text = readme();
    let slug = |heading: &str| heading.trim_start_matches('#').trim().to_lowercase().replace(' ', "-");
    let headings: BTreeSet<String> = text.lines().filter(|l| l.starts_with('#')).map(slug).collect();
    let links: Vec<&str> = text.split("](").skip(1).map(|rest| rest.split_once(')').unwrap().0).collect();
    for link in &links {
        let found = match link.strip_prefix('#') {
            Some(anchor) => headings.contains(anchor),
            None => link.starts_with("https://") || folder().join(link).is_file(),
        };
        assert!(found, "{link}");
    }
    assert!(links.len() > 30);
}

#[test]
fn digest_is_the_one_in_the_text() {
    let digest = geometry_digest(&[[0.0; 3], [1.0, 0.0, 0.0], [0.25, 0.5, -0.0]]);
    assert!(readme().contains(&format!("the triangle above gives `{digest}`")), "{digest}");
}

#[test]
fn examples_satisfy_the_schemas() {
    let text = readme();
    let examples: Vec<Value> = text
        .split("```json")
        .skip(1)
        .map(|rest| serde_json::from_str(&format!("{{{}}}", rest.split_once("```").unwrap().0)).unwrap())
        .collect();
    let places = [
        (format!("scene.{HYBRID}.schema.json"), format!("/scenes/0/extensions/{HYBRID}")),
        (format!("material.{HYBRID}.schema.json"), format!("/extensions/{HYBRID}")),
        (format!("{KHR}.{HYBRID}.schema.json"), format!("/extensions/{KHR}/extensions/{HYBRID}")),
    ];
    assert_eq!(examples.len(), places.len());
    for (example, (schema, place)) in examples.iter().zip(places) {
        let mut findings = Findings::default();
        schema::check(example.pointer(&place).unwrap(), &schema, &place, &mut findings);
        assert!(findings.0.is_empty(), "{:?}", findings.0);
    }
}
