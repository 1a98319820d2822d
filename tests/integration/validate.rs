//! Validation of files made by other projects. `CENTAUR_DATA` names the folder (default `../shared/data`).

use crate::common::data;
use centaur::format::{Severity, Validation, validate};

fn errors(validation: &Validation) -> Vec<String> {
    let errors = validation.findings.iter().filter(|f| f.severity == Severity::Error);
    errors.map(|f| format!("{} {}", f.code, f.location)).collect()
}

#[test]
#[ignore = "needs shared data"]
fn khronos_samples_have_no_errors() {
    let mut checked = 0;
    for model in data("meshes_gltf_samples").read_dir().unwrap() {
        for folder in ["glTF", "glTF-Binary"].map(|f| model.as_ref().unwrap().path().join(f)) {
            for file in folder.read_dir().into_iter().flatten().map(|f| f.unwrap().path()) {
                if file.extension().is_some_and(|e| e == "gltf" || e == "glb") {
                    let validation = validate(&file).unwrap();
                    assert_eq!(validation.errors, 0, "{validation}");
                    checked += 1;
                }
            }
        }
    }
    assert_eq!(checked, 12);
}

#[test]
#[ignore = "needs shared data"]
fn the_drafts_example_and_its_five_faults() {
    let example = validate(&data("../gltf-draft/example.gltf")).unwrap();
    assert_eq!(example.errors, 0, "{example}");
    let bad = validate(&data("../gltf-draft/bad.gltf")).unwrap();
    let hybrid = "/extensions/EXT_gaussian_splatting_hybrid";
    let splats = "/meshes/1/primitives/0/extensions/KHR_gaussian_splatting";
    let expected = [
        format!("SCHEMA_REQUIRED {splats}: "),
        format!("SCHEMA_RANGE /scenes/0{hybrid}/lambda: "),
        format!("SCHEMA_CHOICE /materials/0{hybrid}/opacity: "),
        format!("SCHEMA_RANGE /materials/0{hybrid}/sphericalHarmonics/degree: "),
        format!("SCHEMA_REQUIRED {splats}{hybrid}/binding: "),
    ];
    assert_eq!(errors(&bad), expected);
}

#[test]
#[ignore = "needs shared data"]
fn splats_of_other_programs() {
    let train = validate(&data("oracle_metalsplatter/SplatIO/TestData/test-splat.3-points-from-train.ply")).unwrap();
    assert_eq!(train.errors, 0, "{train}");
    let cube = validate(&data("oracle_javagl/jsplat-examples/data/unitCube-ascii.ply")).unwrap();
    assert_eq!(cube.errors, 0, "{cube}");
    // Written for an early draft of KHR_gaussian_splatting, with other names.
    let draft = validate(&data("oracle_cesium_gltf_splat/synthetic_5splats.gltf")).unwrap();
    assert!(errors(&draft).iter().any(|e| e.starts_with("SPLAT_ATTRIBUTE_MISSING")), "{draft}");
}
