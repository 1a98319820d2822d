//! Meshes that are faulty or do not fit their capture, and flags of meshes that have no effect: refused in one line, or
//! noted.

use crate::bad_input::{OF_A_MESH, edit, folder_with_capture, train};
use crate::common::{self, centaur, failure, stderr};
use centaur::format::{WriteOptions, write_scene};
use centaur::scene::{Composition, HybridScene, Splats};

#[test]
fn surfaces_of_no_splats() {
    let folder = folder_with_capture(8);
    let empty = HybridScene { splats: Splats::empty(0), meshes: vec![], composition: Composition::default() };
    write_scene(&folder.path().join("empty.ply"), &empty, &WriteOptions::default()).unwrap();
    let line = failure(folder.path(), centaur(folder.path()).args(["mesh", "empty.ply", "capture", "-o", "s.glb"]));
    assert_eq!(line, "error: empty.ply: expected trained splats, found none");
}

/// Variants of a benchmark share flags with hybrid variants.
#[test]
fn flags_of_a_mesh_beside_none_are_noted() {
    let folder = folder_with_capture(8);
    let more = ["--no-mesh", "--max-splats", "500", "--triangles", "9", "--shell", "off", "--band-degree", "2"];
    let output = train(folder.path(), more).args(OF_A_MESH).output().unwrap();
    let note = "note: --no-mesh: --surface-iterations, --triangles, --shell, --warmup have no effect\n";
    assert_eq!((output.status.code(), &*stderr(&output)), (Some(0), note));
    // With a given mesh, flags for the extraction of a surface.
    std::fs::write(folder.path().join("mesh.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
    let more =
        ["--mesh", "mesh.obj", "--texture-size", "64", "--max-splats", "500", "--planar", "off", "--lambda", "0"];
    let output = train(folder.path(), more).output().unwrap();
    assert_eq!((output.status.code(), &*stderr(&output)), (Some(0), "note: --mesh: --planar has no effect\n"));
    // An order by depth alone does not use λ.
    let more =
        ["--mesh", "mesh.obj", "--texture-size", "64", "--max-splats", "500", "--mode", "direct", "--lambda", "0"];
    let output = train(folder.path(), more).output().unwrap();
    let note = "note: --mode direct: --lambda has no effect\n";
    assert_eq!((output.status.code(), &*stderr(&output)), (Some(0), note));
}

/// Usually such meshes are in another unit or frame than the poses.
#[test]
fn meshes_that_no_view_sees_are_refused() {
    let folder = folder_with_capture(8);
    std::fs::write(folder.path().join("mesh.obj"), "v 0 100 0\nv 1 100 0\nv 0 101 0\nf 1 2 3\n").unwrap();
    let before = common::tree(folder.path());
    let output = train(folder.path(), ["--mesh", "mesh.obj", "--max-splats", "500"]).output().unwrap();
    let ask = "is it in the frame and unit of the camera poses?";
    let expected = format!(
        "note: mesh.obj: is near hardly any of the points of the capture: {ask}\n\
         error: mesh.obj: expected a mesh that training views see, found none of it in any view: {ask}\n"
    );
    assert_eq!((output.status.code(), stderr(&output)), (Some(1), expected));
    assert_eq!(common::tree(folder.path()), before);
}

/// The cameras are inside the mesh.
#[test]
fn meshes_in_another_unit_than_the_poses_are_noted() {
    let folder = folder_with_capture(8);
    let mesh = |unit: f32| {
        let corner = |[x, y, z]: [f32; 3]| format!("v {} {} {}\n", unit * x, unit * y, unit * z);
        let corners = [[0.4, 0.0, -0.3], [-0.4, 0.3, -0.3], [-0.4, -0.3, -0.3], [0.0, 0.0, 0.4]].map(corner);
        std::fs::write(folder.path().join("mesh.obj"), corners.concat() + "f 1 2 3\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
            .unwrap();
        let output = train(folder.path(), ["--mesh", "mesh.obj", "--max-splats", "500"]).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{unit}: {}", stderr(&output));
        stderr(&output)
    };
    assert_eq!([1.0, 0.5].map(mesh), ["", ""]);
    let note = "note: mesh.obj: is near hardly any of the points of the capture: is it in the frame and unit of the camera poses?\n";
    assert_eq!(mesh(100.0), note);
}

#[test]
fn meshes_without_triangles() {
    let folder = folder_with_capture(8);
    let header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n";
    for (name, content) in [
        ("points.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n".to_owned()),
        ("lines.obj", "v 0 0 0\nv 1 0 0\nl 1 2\n".to_owned()),
        ("points.ply", format!("{header}end_header\n0 0 0\n")),
        ("text.ply", "not a mesh".to_owned()),
        ("empty.glb", String::new()),
    ] {
        std::fs::write(folder.path().join(name), content).unwrap();
        let line = failure(folder.path(), &mut train(folder.path(), ["--mesh", name]));
        assert!(line.starts_with(&format!("error: {name}: ")) && line.contains("expected"), "{line}");
    }
}

#[test]
fn surfaces_without_room_name_their_file() {
    let folder = folder_with_capture(8);
    let apart = |i: i32| format!("v {i} 0 0\nv {i}.5 0 0\nv {i} 1 0\nf -3 -2 -1\n");
    std::fs::write(folder.path().join("apart.obj"), (0..200).map(apart).collect::<String>()).unwrap();
    let line = failure(folder.path(), &mut train(folder.path(), ["--mesh", "apart.obj", "--texture-size", "16"]));
    assert!(line.starts_with("error: apart.obj: making the mesh: unwrap: expected the 200 charts "), "{line}");
    assert!(line.ends_with("; see --texture-size, and centaur mesh --mesh, which simplifies"), "{line}");

    edit(&folder.path().join("capture/sparse/0/points3D.txt"), |_| "1 0 0 0 1 2 3 0.1\n".to_owned());
    let line = failure(folder.path(), centaur(folder.path()).args(["mesh", "capture", "-o", "s.glb"]));
    assert!(line.starts_with("error: capture: surface: expected triangles after lifting "), "{line}");
}

#[test]
fn uvs_of_a_mesh_that_are_not_kept_are_noted() {
    let folder = folder_with_capture(8);
    let vertices = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvt 1 1\n";
    for (material, notes) in
        [("a", ""), ("b", "note: mesh.obj: its UVs are not kept, new ones are made: they belong to 2 materials\n")]
    {
        let faces = format!("usemtl a\nf 1/1 2/2 3/3\nusemtl {material}\nf 2/2 4/4 3/3\n");
        std::fs::write(folder.path().join("mesh.obj"), [vertices, &faces].concat()).unwrap();
        let output = train(folder.path(), ["--mesh", "mesh.obj", "--max-splats", "500"]).output().unwrap();
        assert_eq!((output.status.code(), &*stderr(&output)), (Some(0), notes));
    }
}
