//! Translates kernels that tests compile into the languages of Metal and Direct3D 12, by the translator that wgpu uses
//! there, so that what these cannot express fails without such an adapter.

use std::{
    collections::BTreeSet,
    sync::{Mutex, PoisonError},
};

use naga::{
    ShaderStage,
    back::{hlsl, msl},
    front::wgsl,
    proc::{BoundsCheckPolicies, BoundsCheckPolicy},
    valid::{Capabilities, ValidationFlags, Validator},
};

/// Panics unless entry point `entry` of `text` translates to old and new versions. Kernels with subgroups need Metal
/// 2.1 and shader model 6.0, as those have subgroups; the others also translate to Metal 2.0 and shader model 5.1, the
/// oldest that wgpu takes.
pub(super) fn check(text: &str, entry: &str, subgroups: bool) {
    static DONE: Mutex<BTreeSet<(String, String)>> = Mutex::new(BTreeSet::new());
    let mut done = DONE.lock().unwrap_or_else(PoisonError::into_inner);
    if !done.insert((text.to_owned(), entry.to_owned())) {
        return;
    }
    drop(done);
    let module = wgsl::parse_str(text).unwrap();
    let capabilities = if subgroups { Capabilities::SUBGROUP } else { Capabilities::empty() };
    let info = Validator::new(ValidationFlags::all(), capabilities).validate(&module).unwrap();
    let entry_point = Some((ShaderStage::Compute, entry.to_owned()));

    let pipeline = msl::PipelineOptions { entry_point: entry_point.clone(), ..Default::default() };
    // Metal does not check bounds itself; wgpu checks no binding arrays.
    let [index, buffer, image_load] = [BoundsCheckPolicy::Restrict; 3];
    let bounds_check_policies =
        BoundsCheckPolicies { index, buffer, image_load, binding_array: BoundsCheckPolicy::Unchecked };
    for lang_version in [if subgroups { (2, 1) } else { (2, 0) }, (3, 1)] {
        let options = msl::Options {
            lang_version,
            bounds_check_policies,
            zero_initialize_workgroup_memory: false,
            ..Default::default()
        };
        let written = msl::write_string(&module, &info, &options, &pipeline);
        let (text, _) = written.unwrap_or_else(|e| panic!("{entry}, Metal {lang_version:?}: {e}"));
        assert!(text.contains("kernel void"), "{entry}, Metal {lang_version:?}: {text}");
    }

    let pipeline = hlsl::PipelineOptions { entry_point };
    let models = [hlsl::ShaderModel::V5_1, hlsl::ShaderModel::V6_0, hlsl::ShaderModel::V6_6];
    for shader_model in models.into_iter().skip(usize::from(subgroups)) {
        let options = hlsl::Options { shader_model, zero_initialize_workgroup_memory: false, ..Default::default() };
        let mut text = String::new();
        let written = hlsl::Writer::new(&mut text, &options, &pipeline).write(&module, &info, None);
        written.unwrap_or_else(|e| panic!("{entry}, {shader_model:?}: {e}"));
        assert!(text.contains("numthreads"), "{entry}, {shader_model:?}: {text}");
    }
}
