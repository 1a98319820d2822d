//! Splats bound to triangles of animated documents.

use glam::{DQuat, Quat};
use serde_json::{Value, json};

use super::core_tests::near;
use super::extension::HYBRID;
use super::moving_tests::{HALF, INTEGERS, bound};

#[test]
fn splats_follow_their_triangle_or_their_node() {
    for (harmonics, turns) in [("triangle", true), ("node", false)] {
        let file = bound(harmonics, |_| ());
        let rest = file.rest();
        assert!(!rest.notes.iter().any(|note| note.contains("binding")), "{:?}", rest.notes);
        // Before anything has moved the scene is bit-identical.
        assert_eq!(file.at(0.0).scene, rest.scene);
        let posed = file.at(1.0).scene.splats;
        // After a quarter turn about z the triangle's centre is at (−1/3, 1/3), with the splat above it.
        near(&posed.means()[0].to_array(), &[-1.0 / 3.0, 1.0 / 3.0, 0.5], 1e-6);
        near(&posed.means()[1].to_array(), &[1.0, 0.0, 2.0], 1e-6);
        let expected = DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2).as_quat();
        assert!(posed.rotations()[0].dot(expected).abs() > 1.0 - 1e-6, "{}", posed.rotations()[0]);
        assert_eq!(posed.rotations()[1], Quat::IDENTITY);
        near(&posed.log_scales()[0].to_array(), &rest.scene.splats.log_scales()[0].to_array(), 1e-6);
        // Band 1 is y, z, x with factors −, +, −: after a quarter turn the x component has become the y component.
        let [y, z, x] = [1, 2, 3].map(|k| rest.scene.splats.sh_of(0)[k]);
        let found = posed.sh_of(0);
        let expected = if turns { [x, z, y.map(|v| -v)] } else { [y, z, x] };
        for (found, expected) in found[1..].iter().zip(expected) {
            near(found, &expected, 1e-6);
        }
        assert_eq!(posed.sh_of(1), rest.scene.splats.sh_of(1));
    }
}

#[test]
fn bindings_that_do_not_hold_are_ignored_and_said() {
    let object =
        "/meshes/1/primitives/0/extensions/KHR_gaussian_splatting/extensions/EXT_gaussian_splatting_hybrid/binding";
    let with = |key: &str, value: Value| {
        let file = bound("node", |document| document.pointer_mut(object).unwrap()[key] = value.clone());
        let rest = file.rest();
        assert_eq!(file.at(1.0).scene.splats.means()[0], rest.scene.splats.means()[0], "{key}");
        rest.notes.join("; ")
    };
    assert!(
        with("triangleCount", json!(2)).contains("binding: ignored: expected a binding of 1 triangles, found one of 2")
    );
    assert!(with("geometryDigest", json!("0123456789abcdef")).contains("found 0123456789abcdef"));
    assert!(with("node", json!(2)).contains("expected triangles at node 2"));
    assert!(with("frame", json!("other")).contains("found `other`"));
    assert!(with("sphericalHarmonicsFrame", json!("other")).contains("found `other`"));
    assert!(with("translations", json!(0)).contains("expected 1 elements, one per splat, found 3"));
    assert!(with("scales", json!(99)).contains("/accessors"));
    assert!(with("scales", json!(INTEGERS)).contains("binding: ignored: expected scales of Float, found U16"));
    assert!(with("translations", json!(INTEGERS)).contains("expected translations of Float, found U16"));
    let said = with("rotations", json!(HALF));
    assert!(said.contains("expected rotations of length 1, found length 0.5000 of element 0"), "{said}");
    // A triangle strip of one triangle, with the same digest.
    let strip = bound("node", |document| document["meshes"][0]["primitives"][0]["mode"] = json!(5)).rest();
    let said = "expected triangles at node 0, primitive 0, of mode 4, found none in the scene";
    assert!(strip.notes.iter().any(|note| note.ends_with(said)), "{:?}", strip.notes);
    assert_eq!(strip.scene.meshes[0].triangles().len(), 1);
    let mirrored = bound("triangle", |document| document["nodes"][1]["scale"] = json!([1, 1, -1]));
    assert!(mirrored.rest().notes.join("; ").contains("binding: ignored: expected a node that does not mirror"));
}

#[test]
fn fields_are_not_played_and_that_is_said() {
    let object = "/meshes/2/primitives/0/extensions/KHR_gaussian_splatting/extensions";
    let file = bound("node", |document| {
        *document.pointer_mut(object).unwrap() = json!({ HYBRID: { "deformation": 0 } });
    });
    let said = format!("{object}/{HYBRID}/deformation: not played: its splats are shown undeformed");
    assert!(file.rest().notes.contains(&said), "{:?}", file.rest().notes);
}

#[test]
fn bindings_are_read_where_the_triangle_keeps_still() {
    let still = |damage: &dyn Fn(&mut Value)| {
        bound("node", |document| {
            // Node 1, which holds the splats, rotates instead of the triangle.
            document["animations"][0]["channels"][0]["target"]["node"] = json!(1);
            damage(document);
        })
    };
    let file = still(&|_| ());
    let (rest, posed) = (file.rest().scene.splats, file.at(1.0).scene.splats);
    assert_eq!((rest.means()[0], rest.rotations()[0]), (posed.means()[0], posed.rotations()[0]));
    let [y, z, x] = [1, 2, 3].map(|k| rest.sh_of(0)[k]);
    for (found, expected) in posed.sh_of(0)[1..].iter().zip([x, z, y.map(|v| -v)]) {
        near(found, &expected, 1e-6);
    }
    let file = still(&|document| {
        let at =
            "/meshes/1/primitives/0/extensions/KHR_gaussian_splatting/extensions/EXT_gaussian_splatting_hybrid/binding";
        document.pointer_mut(at).unwrap()["triangleCount"] = json!(7);
        document["animations"][0]["channels"].as_array_mut().unwrap().remove(0);
    });
    let notes = file.rest().notes.join("; ");
    assert!(notes.contains("binding: ignored: expected a binding of 1 triangles, found one of 7"), "{notes}");
}
