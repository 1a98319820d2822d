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
    valid::{Capabilities, ValidationFlags, Validator},
};

/// Panics unless entry point `entry` of `text` translates. Kernels with subgroups need Metal 2.1 and shader model 6.0,
/// as those have subgroups; the others also translate to Metal 2.0 and shader model 5.1, the oldest that wgpu takes.
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

    let metal = msl::Options {
        lang_version: if subgroups { (2, 1) } else { (2, 0) },
        zero_initialize_workgroup_memory: false,
        ..Default::default()
    };
    let pipeline = msl::PipelineOptions { entry_point: entry_point.clone(), ..Default::default() };
    let (metal, _) = msl::write_string(&module, &info, &metal, &pipeline).unwrap_or_else(|e| panic!("{entry}: {e}"));
    assert!(metal.contains("kernel void"), "{entry}: {metal}");

    let direct3d = hlsl::Options {
        shader_model: if subgroups { hlsl::ShaderModel::V6_0 } else { hlsl::ShaderModel::V5_1 },
        zero_initialize_workgroup_memory: false,
        ..Default::default()
    };
    let pipeline = hlsl::PipelineOptions { entry_point };
    let mut text = String::new();
    let written = hlsl::Writer::new(&mut text, &direct3d, &pipeline).write(&module, &info, None);
    written.unwrap_or_else(|e| panic!("{entry}: {e}"));
    assert!(text.contains("numthreads"), "{entry}: {text}");
}
