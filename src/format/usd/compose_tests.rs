//! Composition within a layer. What is expected of strengths and paths is what OpenUSD 26.3 says of the same layers.

use glam::Vec3;

use super::tests::read_text;
use super::*;
use crate::scene::{Mesh, sh};

const TRIANGLE: &str = "point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    uniform token subdivisionScheme = \"none\"";

fn composed_text(text: &str) -> (Layer, Vec<String>) {
    composed(format!("#usda 1.0\n{text}").into_bytes()).map_err(|fault| fault.in_file(Path::new("f"))).unwrap()
}

/// Number of an attribute at a path of a prim; `None` if there is none.
fn number(layer: &Layer, prim: &str, name: &str) -> Option<f64> {
    let stage = Stage::new(layer);
    let (prim, _) = stage.find(0, prim)?;
    stage.number(prim, name)
}

/// Whether a prim is there, and as what.
fn specifier(layer: &Layer, prim: &str) -> Option<Specifier> {
    let stage = Stage::new(layer);
    stage.find(0, prim).map(|(prim, _)| stage.prims[prim].specifier)
}

fn target(layer: &Layer, prim: &str, name: &str) -> Option<String> {
    let stage = Stage::new(layer);
    let (prim, _) = stage.find(0, prim)?;
    stage.prims[prim].target(name).map(str::to_owned)
}

fn color(mesh: &Mesh) -> [f32; 3] {
    sh::rgb_from_dc(mesh.atlas().base().texels()[..3].try_into().unwrap()).map(f32::round)
}

#[test]
fn what_an_override_refers_to_elsewhere_is_named() {
    let file = read_text(
        r#"( metersPerUnit = 1 )
def "W" {
    over "x" ( references = @a.usda@ ) {}
    over "y" ( prepend payload = @a.usda@</A> ) {}
    over "z" ( active = false references = @a.usda@ ) {}
    over "above" { over "below" ( references = @a.usda@ ) {} }
    class "c" ( references = @a.usda@ ) {}
}
"#,
    );
    let of = |arc: &str| format!("1 prim with {arc} to other layers, which are not followed");
    assert_eq!(file.notes, [of("payload"), of("references")]);
}

#[test]
fn prims_of_the_layer_are_referred_to() {
    let file = read_text(&format!(
        r#"( metersPerUnit = 1 )
def Xform "W" {{
    def Mesh "m" {{ {TRIANGLE} }}
    def "copy" ( references = </W/m> ) {{
        double3 xformOp:translate = (5, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
}}
"#
    ));
    let [first, copy] = &file.scene.meshes[..] else { panic!("{:?}", file.notes) };
    let moved: Vec<Vec3> = first.positions().iter().map(|&p| p + Vec3::new(5.0, 0.0, 0.0)).collect();
    assert_eq!(copy.positions(), moved);
    assert!(!file.notes.iter().any(|note| note.contains("followed")), "{:?}", file.notes);
}

#[test]
fn opinions_have_their_order_of_strength() {
    let (layer, notes) = composed_text(
        r#"
def "M" {
    def "b" ( inherits = </M/K> ) { int own = 1 rel r = </M/b> rel q = </C> rel s = <x> rel up = <../K> }
    class "K" { int k = 1 int own = 7 }
}
def "N" ( references = </M> ) { over "K" { int k = 2 } }
class "_c" { int a = 1 }
over "o" ( inherits = </_c> ) {}
over "o2" ( references = </M> ) {}
def "V" ( references = </V0> variants = { string v = "b" } ) {}
def "V0" ( variants = { string v = "a" } prepend variantSets = "v" ) {
    int p = 0
    variantSet "v" = { "a" { int p = 1 int q = 1 } "b" { int p = 2 int q = 2 def "in" {} } }
}
def "V3" ( references = </V/in> ) {}
def "R" ( references = [</M>, </V0>] ) {}
def "S" ( specializes = </Weak> references = </V0> ) {}
def "Weak" { int p = 9 int w = 9 }
def "I" ( instanceable = true references = </M> ) { over "b" { int own = 8 } }
def "Samples" ( references = </Default> ) { int x.timeSamples = { 1: 5 } }
def "Default" { int x = 6 int y = 6 }
def "C" {}
"#,
    );
    assert_eq!(notes, Vec::<String>::new());
    let at = |prim: &str, name: &str| number(&layer, prim, name);
    assert_eq!([at("/M/b", "own"), at("/M/b", "k"), at("/M/b", "none")], [Some(1.0), Some(1.0), None]);
    // The class is overridden where its prim is, which counts for what inherits it there.
    assert_eq!([at("/N/b", "k"), at("/N/b", "own"), at("/N/K", "k")], [Some(2.0), Some(1.0), Some(2.0)]);
    let of_n = ["r", "q", "s", "up"].map(|name| target(&layer, "/N/b", name).unwrap());
    assert_eq!(of_n, ["/N/b", "/C", "/N/b/x", "/N/K"]);
    assert_eq!(target(&layer, "/M/b", "r").unwrap(), "/M/b");
    let specifiers = ["/o", "/o2", "/o2/b", "/N/K", "/V0/in", "/V/in"].map(|prim| specifier(&layer, prim));
    let [class, def] = [Some(Specifier::Class), Some(Specifier::Def)];
    assert_eq!(specifiers, [class, def, def, class, None, def]);
    // Local opinions are stronger than variants, whose selection is that of whatever refers to them.
    assert_eq!([at("/V0", "p"), at("/V0", "q"), at("/V", "p"), at("/V", "q")], [0.0, 1.0, 0.0, 2.0].map(Some));
    assert_eq!([at("/R", "p"), at("/R/b", "k")], [0.0, 1.0].map(Some));
    assert_eq!([at("/S", "p"), at("/S", "w")], [0.0, 9.0].map(Some));
    assert_eq!(at("/I/b", "own"), Some(1.0), "not what is said besides about a part of an instance");
    assert_eq!([at("/Samples", "x"), at("/Samples", "y")], [5.0, 6.0].map(Some));
    assert!(specifier(&layer, "/V3").is_some());
}

#[test]
fn edits_of_targets_go_down_to_the_weakest_opinion() {
    let (layer, _) = composed_text(
        r#"
class "A" { rel r = [</Red>, </Blue>, </Green>] }
class "B" ( inherits = </A> ) { delete rel r = </Blue> }
def "P" ( inherits = </B> ) { delete rel r = </Red> }
def "Q" ( inherits = </B> ) { prepend rel r = </Gray> }
"#,
    );
    assert_eq!(["/P", "/Q"].map(|prim| target(&layer, prim, "r").unwrap()), ["/Green", "/Gray"]);
}

/// Each is as deep as the arcs before it.
#[test]
fn arcs_in_variants_do_not_nest_without_end() {
    let chain = |i: usize| {
        let next = i + 1;
        format!(
            r#"def "P{i}" ( variants = {{ string v = "a" }} prepend variantSets = "v" ) {{
    variantSet "v" = {{ "a" ( references = </P{next}> ) {{}} }}
}}
"#
        )
    };
    let text = format!("#usda 1.0\n{}def \"P900\" {{}}\n", (0..900).map(chain).collect::<String>());
    let fault = composed(text.into_bytes()).map(|_| ()).unwrap_err().in_file(Path::new("f")).to_string();
    assert!(fault.contains("by repeated use"), "{fault}");
}

#[test]
fn selected_variants_are_read() {
    let read = |selection: &str| {
        read_text(&format!(
            r#"( metersPerUnit = 1 )
def Xform "W" ( {selection} prepend variantSets = ["lod", "place"] ) {{
    variantSet "lod" = {{
        "a" {{ def Mesh "m" {{ {TRIANGLE} }} }}
        "b" ( variants = {{ string place = "up" }} ) {{
            def Mesh "m" {{ {TRIANGLE} }}
            def Mesh "n" {{ {TRIANGLE} }}
        }}
    }}
    variantSet "place" = {{
        "up" {{
            double3 xformOp:translate = (0, 0, 7)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }}
    }}
}}
"#
        ))
    };
    let places = |selection: &str| {
        let file = read(selection);
        let depths = file.scene.meshes.iter().map(|mesh| mesh.positions()[0].z.abs()).collect::<Vec<_>>();
        (depths, file.notes.iter().any(|note| note == "1 prim with variants, none of which is selected"))
    };
    assert_eq!(places(""), (vec![], true));
    // One set has a selected variant, the other has not.
    assert_eq!(places("variants = { string lod = \"a\" }"), (vec![0.0], true));
    assert_eq!(places("variants = { string lod = \"b\" }"), (vec![7.0; 2], false));
    assert_eq!(places("variants = { string lod = \"none\" string place = \"up\" }"), (vec![], true));
}

#[test]
fn circles_and_missing_prims_are_named() {
    let (layer, notes) = composed_text(
        r#"
def "A" ( references = </B> ) { def "x" {} }
def "B" ( references = </A> ) { def "y" {} }
def "C" ( references = </C/D> ) { def "D" { def "z" {} } }
def "E" ( references = </None> inherits = </_none> ) {}
def "F" ( references = <> ) {}
"#,
    );
    let circle = "an arc that leads back to its own prim, or through too many others, is not followed";
    let astray = "a reference to a prim that is not in the layer is not followed";
    assert_eq!(notes, [format!("/E and 1 more: {astray}"), format!("/A and 2 more: {circle}")]);
    assert!(["/A/x", "/A/y", "/B/x", "/B/y", "/C/D/z"].iter().all(|prim| specifier(&layer, prim).is_some()));
    // By way of what is above the prims.
    let (_, notes) = composed_text(
        r#"
def "A" { def "x" ( references = </B/y> ) {} }
def "B" ( references = </C/z> ) {}
def "C" ( references = </A/x/w> ) {}
"#,
    );
    assert!(!notes.is_empty() && notes.len() <= 2, "{notes:?}");
}

#[test]
fn references_that_multiply_beyond_measure_are_refused() {
    let level = |i: usize| {
        let next = i + 1;
        format!(
            "def \"L{i}\" {{ def \"a\" ( references = </L{next}> ) {{}} def \"b\" ( references = </L{next}> ) {{}} }}\n"
        )
    };
    let refused = |text: &str| composed(text.as_bytes().to_vec()).unwrap_err().in_file(Path::new("f")).to_string();
    let levels: String = (0..40).map(level).collect();
    let message = refused(&format!("#usda 1.0\n{levels}def \"L40\" {{}}\n"));
    assert!(message.contains(" bytes, composed of a layer of this size, found more, by repeated use"), "{message}");
    assert!(message.len() < 600, "{message}");
    // Many at one prim.
    let level = |i: usize| format!("def \"L{i}\" ( references = </L{0}> payload = </L{0}> ) {{}}\n", i + 1);
    let levels: String = (0..40).map(level).collect();
    let message = refused(&format!("#usda 1.0\n{levels}def \"L40\" {{}}\n"));
    assert!(message.contains("composed of a layer of this size"), "{message}");
    // Deeper than a layer may be.
    let level =
        |i: usize| format!("def \"L{i}\" {{ def \"a\" {{ def \"b\" ( references = </L{}> ) {{}} }} }}\n", i + 1);
    let levels: String = (0..120).map(level).collect();
    let message = refused(&format!("#usda 1.0\n{levels}def \"L120\" {{}}\n"));
    assert!(message.contains("expected at most 200 levels of prims, found more, by references"), "{message}");
    // A chain of arcs.
    let levels: String = (0..400).map(|i| format!("def \"L{i}\" ( inherits = </L{}> ) {{}}\n", i + 1)).collect();
    let (layer, notes) = composed_text(&format!("{levels}def \"L400\" {{ int x = 1 }}\n"));
    assert_eq!((number(&layer, "/L399", "x"), notes.len()), (Some(1.0), 1), "{notes:?}");
}

#[test]
fn layers_without_arcs_stay_as_they_are() {
    let text = "def \"b\" {}\ndef \"a\" ( references = @other.usda@ ) { def \"c\" {} def \"c\" {} }\n";
    let (layer, notes) = composed_text(text);
    assert_eq!((layer, notes.len()), (document(format!("#usda 1.0\n{text}").into_bytes()).unwrap(), 0));
}

/// From a file that usd-core made of one in text.
#[test]
fn binary_is_composed_as_its_text() {
    let at = |name: &str| Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/usd").join(name);
    let [text, binary] = ["composed.usda", "composed.usdc"].map(|name| read(&at(name)).unwrap());
    assert_eq!((&text.scene, &text.notes), (&binary.scene, &binary.notes));
    let [red, green] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    // Color, and the second vertex, in the capture's frame.
    let expected = [
        (red, [2.0, 0.0, 0.0]),
        (green, [1.0, 0.0, -5.0]),
        (red, [3.0, 0.0, 0.0]),
        (red, [3.0, 0.0, -21.0]),
        (red, [1.0, 0.0, 0.0]),
        (red, [1.0, 0.0, -7.0]),
        (red, [1.0, 0.0, 0.0]),
    ];
    let found = text.scene.meshes.iter().map(|mesh| (color(mesh), mesh.positions()[1].to_array()));
    assert_eq!(found.collect::<Vec<_>>(), expected);
    let last: Vec<&str> = text.notes.iter().rev().take(4).map(String::as_str).collect();
    assert_eq!(
        last,
        [
            "/World/back: an arc that leads back to its own prim, or through too many others, is not followed",
            "/World/astray: a reference to a prim that is not in the layer is not followed",
            "1 prim with references to other layers, which are not followed",
            "1 prim with payload to other layers, which are not followed",
        ]
    );
}
