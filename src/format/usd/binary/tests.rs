//! Tests on tests/data/usd: a layer in text, and its binary version written by `Sdf.Layer.Export` of usd-core 26.3.

use std::path::Path;

use proptest::prelude::*;

use super::cursor::Cursor;
use super::tree::nodes;
use super::values::Rep;
use super::{Crate, END, PathNode, most_values, parse};
use crate::format::error::Fault;
use crate::format::usd::document::{Layer, Prim, PropertyKind, Value, field};

const TEXT: &[u8] = include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/usd/types.usda"));
const BINARY: &[u8] = include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/usd/types.usdc"));

fn text() -> Layer {
    crate::format::usd::parse::parse(TEXT).map_err(|fault| fault.in_file(Path::new("f"))).unwrap()
}

fn binary() -> Layer {
    parse(BINARY).map_err(|fault| fault.in_file(Path::new("f"))).unwrap()
}

/// The text has decimals of half floats, which are rounded when stored.
fn stored(type_name: &str, value: &Value) -> Value {
    match value {
        Value::Floats(all) if type_name.contains("half") || type_name.trim_end_matches("[]").ends_with('h') => {
            Value::Floats(all.iter().map(|&v| half::f16::from_f32(v).to_f32()).collect())
        }
        value => value.clone(),
    }
}

fn assert_same(text: &Prim, binary: &Prim) {
    let id = |p: &Prim| (p.specifier, p.type_name.clone(), p.name.clone(), p.children.len(), p.properties.len());
    assert_eq!(id(text), id(binary));
    let variants = |prim: &Prim| {
        let all =
            prim.variants.iter().map(|variant| (variant.set.clone(), variant.name.clone(), variant.content.clone()));
        let mut all: Vec<_> = all.collect();
        all.sort_by(|a, b| (&a.0, &a.1).cmp(&(&b.0, &b.1)));
        all
    };
    let (of_text, of_binary) = (variants(text), variants(binary));
    assert_eq!(of_text.len(), of_binary.len());
    for ((set, name, content), (set_back, name_back, content_back)) in of_text.iter().zip(&of_binary) {
        assert_eq!((set, name), (set_back, name_back));
        assert_same(content, content_back);
    }
    for name in ["variants", "variantSets"] {
        assert_eq!(field(&text.metadata, name).is_some(), field(&binary.metadata, name).is_some(), "{name}");
    }
    for property in &text.properties {
        let name = &property.name;
        let other = binary.property(name).unwrap_or_else(|| panic!("{name} is missing"));
        assert_eq!(property.custom, other.custom, "{name}");
        assert_eq!(text.target(name), binary.target(name), "{name}");
        assert_eq!(text.connection(name), binary.connection(name), "{name}");
        if let (PropertyKind::Attribute { type_name, .. }, PropertyKind::Attribute { type_name: theirs, .. }) =
            (&property.kind, &other.kind)
        {
            assert_eq!(type_name, theirs);
            assert_eq!(text.value(name).map(|v| stored(type_name, v)), binary.value(name).cloned(), "{name}");
        }
    }
    let keys = |prim: &Prim| match field(&prim.metadata, "customData") {
        Some(Value::Dictionary(entries)) => entries.iter().map(|entry| entry.key.clone()).collect(),
        _ => vec![],
    };
    assert_eq!(keys(text), keys(binary));
    text.children.iter().zip(&binary.children).for_each(|(a, b)| assert_same(a, b));
}

#[test]
fn binary_says_what_the_text_says() {
    let (text, binary) = (text(), binary());
    assert_same(&text.prims[0], &binary.prims[0]);
    assert_eq!((text.prims.len(), binary.prims.len()), (1, 1));
    for name in ["upAxis", "defaultPrim"] {
        assert_eq!(text.field(name), binary.field(name));
    }
    let unit = |layer: &Layer| layer.field("metersPerUnit").and_then(Value::as_number);
    assert_eq!(unit(&text), unit(&binary));
    let types = binary.prims[0].children.iter().find(|p| p.name == "Types").unwrap();
    assert!(types.properties.len() > 40);
}

#[test]
fn what_is_no_layer_is_refused() {
    let refusal = |bytes: &[u8]| parse(bytes).unwrap_err().in_file(Path::new("f")).to_string();
    assert_eq!(refusal(b"PXR-USDC"), "f: byte 8: expected 8 bytes, found 0 to the end of the file");
    let mut old = BINARY.to_vec();
    old[9] = 3;
    assert_eq!(refusal(&old), "f: byte 8: expected a crate file of version 0.4 to 0.x, found 0.3");
    let mut astray = BINARY.to_vec();
    astray[16..24].fill(0xff);
    let message = format!("f: byte 16: expected offsets within {} bytes, found 18446744073709551615", BINARY.len());
    assert_eq!(refusal(&astray), message);
}

/// In the file, added items come before prepended ones.
#[test]
fn list_edits_lead_to_the_same_list_as_in_text() {
    let list = |flags: u8, lists: &[&[u32]]| {
        let mut bytes = vec![flags];
        for items in lists {
            bytes.extend((items.len() as u64).to_le_bytes());
            bytes.extend(items.iter().flat_map(|item| item.to_le_bytes()));
        }
        Cursor::new(&bytes, 0).and_then(|mut cursor| cursor.list_op()).unwrap()
    };
    let [added, prepended, appended] = [1 << 2, 1 << 5, 1 << 6];
    assert_eq!(list(added | prepended | appended, &[&[1], &[2, 3], &[4]]), [2, 3, 1, 4]);
    assert_eq!(list(added | appended, &[&[1], &[4]]), [1, 4]);
    assert_eq!(list(0b11, &[&[5, 6]]), [5, 6]);
    let text = b"#usda 1.0\ndef \"a\" {\n    add rel r = </b>\n    prepend rel r = </c>\n    append rel r = </d>\n}\n";
    let layer = crate::format::usd::parse::parse(text).unwrap();
    assert_eq!(layer.prims[0].target("r"), Some("/c"));
}

/// If two entries named one path, the later would be the parent of its own ancestor, and walking up would never end.
#[test]
fn paths_that_are_no_tree_are_refused() {
    let of = |places: &[i32], jumps: &[i32]| nodes(4, &[places.to_vec(), vec![1; places.len()], jumps.to_vec()]);
    let parents = |nodes: Vec<PathNode>| nodes.iter().map(|n| (n.parent, n.depth)).collect::<Vec<_>>();
    assert_eq!(parents(of(&[0, 1, 2, 3], &[-1, 2, -2, -2]).unwrap()), [(0, 0), (0, 1), (1, 2), (0, 1)]);
    assert_eq!(parents(of(&[], &[]).unwrap()), [(0, 0); 4]);
    // One path twice; one entry twice; beyond the entries; beyond the paths.
    for (places, jumps) in [
        ([0, 1, 2, 1], [-1, -1, -1, -2]),
        ([0, 1, 2, 3], [-1, 1, -2, -2]),
        ([0, 1, 2, 3], [-1; 4]),
        ([0, 1, 2, 4], [-1, -1, -1, -2]),
    ] {
        assert!(of(&places, &jumps).is_none(), "{places:?} {jumps:?}");
    }
}

/// A million equal entries compress to little, but take much memory when decompressed.
#[test]
fn tables_that_a_file_of_this_size_does_not_justify_are_refused() {
    let counts = [60_000_u64, 60_000].map(u64::to_le_bytes).concat();
    let cursor = || Cursor::new(&counts, 0).unwrap();
    let mut of = Crate {
        file: &counts,
        version: [0, 8],
        fields_at: 0,
        tokens: vec![],
        strings: vec![],
        fields: vec![],
        sets: vec![],
        paths: vec![],
        budget: most_values(counts.len()),
    };
    for fault in [of.read_paths(cursor()).err(), of.read_tokens(cursor()).err(), of.read_fields(cursor()).err()] {
        let message = fault.unwrap().in_file(Path::new("f")).to_string();
        assert!(message.contains(" a count of ") && message.ends_with(" or less, found 60000"), "{message}");
    }
}

#[test]
fn many_names_of_one_long_text_are_refused() {
    const COUNT: u64 = 1000;
    // An animated attribute at 0: the offset of its times, then the number of values, all of which are token 0.
    let inlined = |kind: u64| kind << 48 | 1 << 62;
    let times_at = 8 * (4 + COUNT);
    let mut words = vec![8, 48 << 48 | times_at, 8, COUNT];
    words.extend((0..COUNT).map(|_| inlined(11)));
    words.push(COUNT);
    words.extend((0..COUNT).map(|i| (i as f64).to_bits()));
    // A list of the same number of tokens.
    let list_at = 8 * words.len() as u64;
    words.push(COUNT);
    words.extend((0..COUNT / 2).map(|_| 0));
    let file: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
    let of = |length: usize| Crate {
        file: &file,
        version: [0, 8],
        fields_at: 0,
        tokens: vec!["a".repeat(length)],
        strings: vec![],
        fields: vec![],
        sets: vec![],
        paths: vec![],
        budget: most_values(file.len()),
    };
    // Names of the fields of a prim, and of prims.
    let named = |length: usize, sets: Vec<u32>, specs: usize| {
        let mut file = of(length);
        (file.fields, file.sets) = (vec![(0, Rep(inlined(42)))], sets);
        file.paths = vec![PathNode::default(), PathNode { depth: 1, ..PathNode::default() }];
        let layer = file.layer(&vec![1; specs], &vec![0; specs], &vec![6; specs])?;
        Ok::<_, Fault>((layer.prims.len(), layer.prims[0].metadata.len()))
    };
    let fields = |length: usize| named(length, [vec![0; 1000], vec![END]].concat(), 1);
    let prims = |length: usize| named(length, vec![END], 1000);
    let path = |length: usize| {
        let mut file = of(length);
        file.paths =
            (0..200).map(|depth| PathNode { parent: depth.max(1) - 1, depth, ..PathNode::default() }).collect();
        file.path(199).map(|path| path.len())
    };
    assert_eq!((fields(9).unwrap(), prims(9).unwrap(), path(9).unwrap()), ((1, 1000), (1, 0), 1990));
    let many_paths = || {
        let mut file = of(9);
        file.paths = vec![PathNode::default(); 60_000];
        file.layer(&[], &[], &[])
    };
    for error in [fields(100_000).err(), prims(100_000).err(), path(100_000).err(), many_paths().err()] {
        let error = error.unwrap().in_file(Path::new("f")).to_string();
        assert!(error.ends_with("values, found more"), "{error}");
    }
    let short = of(9).samples(Rep(46 << 48)).unwrap();
    assert_eq!((short.len(), &short[7]), (1000, &(7.0, Value::Text("a".repeat(9)))));
    assert!(of(9).value(Rep(41 << 48 | list_at)).unwrap().is_some());
    for error in [of(100_000).samples(Rep(46 << 48)).err(), of(100_000).value(Rep(41 << 48 | list_at)).err()] {
        let error = error.unwrap().in_file(Path::new("f")).to_string();
        assert!(error.ends_with("values, found more"), "{error}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]
    #[test]
    fn damaged_files_do_not_panic(damage in prop::collection::vec((0..BINARY.len(), any::<u8>()), 1..6), cut in 0..BINARY.len()) {
        let mut bytes = BINARY.to_vec();
        for (at, byte) in damage {
            bytes[at] = byte;
        }
        let _ = parse(&bytes);
        bytes.truncate(cut);
        let _ = parse(&bytes);
    }
}
