//! Conversion of text to a document and back.

use std::path::Path;

use proptest::prelude::*;

use super::document::{
    Entry, Field, Layer, ListEdit, Numeric, Prim, Property, PropertyKind, Scalar, Specifier, Targets, Value, Variant,
};
use super::parse::parse;
use super::print::print;

fn text(layer: &Layer) -> String {
    let mut text = vec![];
    print(layer, &mut text).unwrap();
    String::from_utf8(text).unwrap()
}

fn parsed(text: &str) -> Layer {
    parse(text.as_bytes()).map_err(|fault| fault.in_file(Path::new("f"))).unwrap()
}

fn refusal(text: &str) -> String {
    parse(text.as_bytes()).unwrap_err().in_file(Path::new("f")).to_string()
}

/// Any float except NaN, which is not equal to itself.
fn single() -> impl Strategy<Value = f32> {
    any::<u32>().prop_map(f32::from_bits).prop_filter("equal to itself", |v| !v.is_nan())
}

fn double() -> impl Strategy<Value = f64> {
    any::<u64>().prop_map(f64::from_bits).prop_filter("equal to itself", |v| !v.is_nan())
}

fn word() -> impl Strategy<Value = String> {
    "[a-z_][a-zA-Z0-9_]{0,8}(:[a-z][a-z0-9]{0,4})?".prop_filter("no keyword", |w| {
        ![
            "def", "over", "class", "rel", "custom", "uniform", "varying", "config", "reorder", "prepend", "append",
            "add", "delete", "comment", "inf", "nan", "true", "false",
        ]
        .contains(&w.as_str())
    })
}

fn path() -> impl Strategy<Value = String> {
    "(/[A-Za-z_][a-z0-9]{0,5}){1,3}(\\.outputs:[a-z]{1,3})?"
}

fn untyped() -> impl Strategy<Value = Value> {
    let leaf = prop_oneof![
        Just(Value::Blocked),
        double().prop_map(Value::Number),
        any::<String>().prop_map(Value::Text),
        "[a-z./@ ]{0,12}".prop_filter("no end", |s| !s.contains("@@") && !s.ends_with(['@'])).prop_map(Value::Asset),
        path().prop_map(Value::Path),
    ];
    leaf.prop_recursive(3, 16, 4, |inner| {
        let entry = (prop_oneof![word(), any::<String>()], inner.clone());
        let entry = entry.prop_map(|(key, value)| Entry { type_name: "token".to_owned(), key, value });
        prop_oneof![
            prop::collection::vec(inner.clone(), 0..4).prop_map(Value::List),
            prop::collection::vec(inner, 0..4).prop_map(Value::Tuple),
            prop::collection::vec(entry, 0..4).prop_map(Value::Dictionary),
        ]
    })
}

const TYPES: [&str; 16] = [
    "half3[]",
    "float",
    "point3f[]",
    "quatf",
    "quath[]",
    "texCoord2f[]",
    "color4f",
    "matrix4d[]",
    "matrix2d",
    "double3",
    "frame4d",
    "bool",
    "int[]",
    "int2[]",
    "token",
    "string[]",
];

fn typed() -> impl Strategy<Value = (String, Value)> {
    (0..TYPES.len(), prop::collection::vec((single(), double(), any::<i64>()), 64), 0usize..4, untyped()).prop_map(
        |(which, numbers, count, other)| {
            let name = TYPES[which];
            let count = if name.ends_with("[]") { count } else { 1 };
            let length = Numeric::of(name).map_or(0, |n| n.width() * count);
            let numbers = &numbers[..length];
            let value = match Numeric::of(name).map(|n| n.scalar) {
                None => other,
                Some(Scalar::Float) => Value::Floats(numbers.iter().map(|n| n.0).collect()),
                Some(Scalar::Double) => Value::Doubles(numbers.iter().map(|n| n.1).collect()),
                Some(Scalar::Integer) => Value::Integers(numbers.iter().map(|n| n.2).collect()),
            };
            (name.to_owned(), value)
        },
    )
}

fn edit() -> impl Strategy<Value = Option<ListEdit>> {
    prop::option::of((0usize..4).prop_map(|i| ListEdit::ALL[i]))
}

fn fields() -> impl Strategy<Value = Vec<Field>> {
    let reference = ("[a-z./]{1,12}", path()).prop_map(|(asset, prim)| Value::Reference(asset, prim));
    let field =
        (edit(), word(), prop_oneof![untyped(), reference]).prop_map(|(edit, name, value)| Field { edit, name, value });
    prop::collection::vec(field, 0..3)
}

fn targets() -> impl Strategy<Value = Option<Targets>> {
    let targets = (edit(), prop::collection::vec(path(), 0..3)).prop_map(|(edit, paths)| Targets { edit, paths });
    prop::option::of(targets)
}

fn kind() -> impl Strategy<Value = PropertyKind> {
    let attribute = (typed(), prop::option::of(Just(())), prop::collection::vec(double(), 0..3), targets());
    let attribute = attribute.prop_map(|((type_name, value), has_value, times, connections)| {
        let samples = times.into_iter().map(|time| (time, value.clone())).collect();
        PropertyKind::Attribute { type_name, value: has_value.map(|()| value), samples, connections }
    });
    prop_oneof![attribute, targets().prop_map(|targets| PropertyKind::Relationship { targets })]
}

fn properties() -> impl Strategy<Value = Vec<Property>> {
    let property =
        (word(), any::<(bool, bool)>(), kind(), fields()).prop_map(|(name, (custom, uniform), kind, metadata)| {
            let uniform = uniform && matches!(kind, PropertyKind::Attribute { .. });
            Property { name, custom, uniform, kind, metadata }
        });
    // All statements about an attribute form one property, so names must differ.
    prop::collection::vec(property, 0..4).prop_map(|mut all| {
        all.iter_mut().enumerate().for_each(|(i, p)| p.name = format!("{}{i}", p.name));
        all
    })
}

fn prim() -> impl Strategy<Value = Prim> {
    let own = (0usize..3, prop::option::of(word()), "[A-Za-z_][a-z0-9\"\\\\é]{0,6}", fields(), properties());
    let own = own.prop_map(|(specifier, type_name, name, metadata, properties)| Prim {
        specifier: Specifier::ALL[specifier],
        type_name: type_name.unwrap_or_default(),
        name,
        metadata,
        properties,
        ..Prim::default()
    });
    own.prop_recursive(3, 12, 3, |inner| {
        let variant = (word(), word(), inner.clone()).prop_map(|(set, name, content)| Variant {
            set,
            name,
            content: Prim { specifier: Specifier::Def, type_name: String::new(), name: String::new(), ..content },
        });
        let children = prop::collection::vec(inner.clone(), 0..3);
        (inner, children, prop::collection::vec(variant, 0..3)).prop_map(|(prim, children, variants)| Prim {
            children,
            variants,
            ..prim
        })
    })
}

proptest! {
    #[test]
    fn what_is_printed_is_parsed(metadata in fields(), prims in prop::collection::vec(prim(), 0..3)) {
        let layer = Layer { metadata, prims };
        let printed = text(&layer);
        // Zeros of either sign compare equal; comparing the text as well tells them apart.
        prop_assert_eq!(text(&parsed(&printed)), printed.clone());
        prop_assert_eq!(parsed(&printed), layer, "{}", printed);
    }

    #[test]
    fn damaged_text_does_not_panic(prims in prop::collection::vec(prim(), 1..3), at: usize, byte: u8, cut: usize) {
        let mut bytes = text(&Layer { metadata: vec![], prims }).into_bytes();
        let at = at % bytes.len();
        bytes[at] = byte;
        let _ = parse(&bytes);
        bytes.truncate(10 + cut % bytes.len());
        let _ = parse(&bytes);
    }

    #[test]
    fn any_text_does_not_panic(noise in "[\\]\\[(){}<>@#\"'=a-z0-9.,:; \n\\\\-]{0,60}") {
        let _ = parse(format!("#usda 1.0\n{noise}").as_bytes());
        let _ = parse(format!("#usda 1.0\ndef \"a\" {{ {noise}").as_bytes());
    }
}

#[test]
fn long_arrays_are_printed_in_order() {
    let values: Vec<f32> = (0..3 << 20).map(|i| i as f32 * 0.1).collect();
    let mut prim = Prim::new("Points", "p");
    prim.set("point3f[]", "points", Value::Floats(values));
    let layer = Layer { metadata: vec![], prims: vec![prim] };
    assert!(parsed(&text(&layer)) == layer);
}

#[test]
fn the_grammar_of_others() {
    let layer = parsed(
        r##"#usda 1.0
(
    "What it is"
    customLayerData = {
        dictionary a = { bool b = true; string[] "k k" = ["x", 'y'] }
    }
    subLayers = [ @./a.usd@ (offset = 10; scale = 0.5), @@@b@c.usd@@@ ]
    relocates = { </A>: </B>, }
)
/* a comment
   on two lines */
over "empty" {}
def Xform "World" ( prepend references = @./m.usd@</M> (offset = 1)
    doc = """three "quoted"
lines""" ; kind = 'component' )
{
    reorder nameChildren = ["b", "a"]
    custom double3[] array = [(1, 2, 3,), (4, 5.5, -6e-1),] ( displayName = "n" ) // and another
    float x = 1; float y = None
    float2 x.timeSamples = { 0: (1, 2), 24.5: None, }
    prepend rel r = [</A>, </B.c>]
    rel empty
    string s = "\x41\102\n\"\\é"
    matrix2d m = ( (1, 2), (3, 4) )
    uint64 big = 9007199254740993
    variantSet "v" = { "one" { def "inner" {} } "two" ( kind = "x" ) { int i = 1 } }
    class "c" {}
}
"##,
    );
    let prim = &layer.prims[1];
    assert_eq!(layer.field("comment"), Some(&Value::text("What it is")));
    assert_eq!(super::document::field(&prim.metadata, "doc"), Some(&Value::text("three \"quoted\"\nlines")));
    let reference = Value::Reference("./m.usd".to_owned(), "/M".to_owned());
    assert_eq!(super::document::field(&prim.metadata, "references"), Some(&reference));
    assert_eq!(prim.value("array"), Some(&Value::Doubles(vec![1., 2., 3., 4., 5.5, -0.6])));
    assert_eq!((prim.value("x").and_then(Value::as_number), prim.value("y")), (Some(1.0), None));
    assert_eq!(prim.value("s"), Some(&Value::text("AB\n\"\\é")));
    assert_eq!(prim.value("m"), Some(&Value::Doubles(vec![1., 2., 3., 4.])));
    assert_eq!(prim.value("big"), Some(&Value::Integers(vec![9_007_199_254_740_993])));
    assert_eq!(prim.target("r"), Some("/A"));
    assert_eq!((prim.variants.len(), prim.variants[0].content.children.len()), (2, 1));
    assert_eq!(
        layer.field("subLayers"),
        Some(&Value::List(vec![Value::Asset("./a.usd".to_owned()), Value::Asset("b@c.usd".to_owned()),]))
    );
}

#[test]
fn statements_about_one_attribute_are_one_property_wherever_they_stand() {
    let layer = parsed(
        r##"#usda 1.0
def "a" {
    float x = 1 ( doc = "of the value" )
    float y
    float x.timeSamples = { 0: 2, 1: 3 }
    rel r = </b>
    custom float x.connect = </b.z> ( displayName = "of all" )
    def "b" { float x = 7 }
}
"##,
    );
    let prim = &layer.prims[0];
    assert_eq!(prim.properties.iter().map(|p| p.name.as_str()).collect::<Vec<_>>(), ["x", "y", "r"]);
    let x = prim.property("x").unwrap();
    assert!(x.custom && x.metadata.len() == 2);
    assert_eq!(prim.value("x").and_then(Value::as_number), Some(2.0));
    assert_eq!((prim.samples("x").len(), prim.connection("x")), (2, Some("/b.z")));
    assert_eq!(prim.children[0].value("x").and_then(Value::as_number), Some(7.0));
}

/// Weaker layers, to which deletions apply, are not read.
#[test]
fn list_edits_lead_to_what_they_add() {
    let layer = parsed(
        r##"#usda 1.0
def "a" {
    delete rel r = </x>
    append rel r = </c>
    prepend rel r = [</b>, </d>] ( doc = "of r" )
    delete rel r = </b>
    delete rel none = </x>
    prepend float f.connect = </b.f>
    delete float f.connect = </c.f>
    delete float g.connect = </c.f>
    rel blocked = </b>
    rel blocked = None
}
"##,
    );
    let prim = &layer.prims[0];
    assert_eq!(prim.properties.len(), 5);
    assert_eq!(["r", "none", "blocked"].map(|name| prim.target(name)), [Some("/b"), None, None]);
    assert_eq!(["f", "g"].map(|name| prim.connection(name)), [Some("/b.f"), None]);
    assert_eq!(prim.stated("r", "doc"), Some("of r"));
}

#[test]
fn splines_are_skipped_and_leave_other_values() {
    let layer = parsed(
        r##"#usda 1.0
def "a" {
    double x.spline = {
        bezier, # a comment with }
        pre: sloped(0.57),
        loop: (15, 25, 0, 2, 11.7),
        7: 5.5 & 7.21; post held; { string a = "}\"" string b = '''}''' asset c = @}.png@ },
    }
    double x = 1
    double y.spline = {}
    double z = 2
}
"##,
    );
    let prim = &layer.prims[0];
    let splines = ["x", "y", "z"].map(|name| prim.property(name).unwrap().has_spline());
    assert_eq!(splines, [true, true, false]);
    assert_eq!(["x", "z"].map(|name| prim.value(name).and_then(Value::as_number)), [Some(1.0), Some(2.0)]);
}

#[test]
fn faults_are_named_with_line_and_column() {
    let deep = format!("#usda 1.0\n{}", "def \"a\" {".repeat(300));
    let lists = format!("#usda 1.0\n(a = {}", "[".repeat(100_000));
    let arcs = format!("#usda 1.0\n({}", "a=@x@(".repeat(100_000));
    for (text, message) in [
        ("usda 1.0", "f: line 1, column 1: expected `#usda 1.0`, found `usda`"),
        ("#usda 1.0\n(\n  upAxis 3)", "f: line 3, column 10: expected `=`, found `3)`"),
        ("#usda 1.0\ndefine \"a\" {}", "f: line 2, column 1: expected def, over or class, found `define`"),
        ("#usda 1.0\ndef \"é\" { float x = y }", "f: line 2, column 21: expected a number, found `y`"),
        ("#usda 1.0\ndef \"a\" { float3 x = (1, 2) }", "f: line 2, column 27: expected `,`, found `)`"),
        ("#usda 1.0\ndef \"a\" { float[] x = [1 2] }", "f: line 2, column 26: expected `,` or `]`, found `2]`"),
        ("#usda 1.0\ndef \"a\" { int x = 1.5 }", "f: line 2, column 19: expected an integer, found `1.5`"),
        (
            "#usda 1.0\ndef \"a\" { double x.spline = { { }",
            "f: line 2, column 34: expected `}`, found the end of the file",
        ),
        (
            "#usda 1.0\ndef \"a\" { double x.splin = 1 }",
            "f: line 2, column 28: expected a value, .connect, .timeSamples or .spline, found `1`",
        ),
        (
            "#usda 1.0\ndef \"a\" { double x. = 1 }",
            "f: line 2, column 21: expected a value, .connect, .timeSamples or .spline, found `=`",
        ),
        (
            "#usda 1.0\ndef \"a\" {",
            "f: line 2, column 10: expected a property, a prim or `}`, found the end of the file",
        ),
        ("#usda 1.0\ndef \"a", "f: line 2, column 5: expected a string that is closed, found one that is not"),
        (
            "#usda 1.0\n( a = @b\n)",
            "f: line 2, column 7: expected an asset path that is closed by `@`, found one that is not",
        ),
        ("#usda 1.0\n/* a", "f: line 2, column 1: expected `*/` after `/*`, found `/*`"),
        (&deep, "f: line 2, column 1809: expected at most 200 levels of nesting, found `{def`"),
        (&lists, "expected at most 200 levels of nesting"),
        (&arcs, "expected at most 200 levels of nesting"),
    ] {
        let found = refusal(text);
        assert!(found == message || message.starts_with("expected") && found.contains(message), "{found}");
    }
    let error = parse(b"#usda 1.0\n\xff").unwrap_err().in_file(Path::new("f")).to_string();
    assert_eq!(error, "f: byte 10: expected UTF-8, found byte 0xff");
}
