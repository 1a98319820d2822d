//! Measures, on held-out views, what changes if splats and layers are ordered by the hits of rays from the camera to
//! the means of splats: `cargo run --release --example layer_order -- SCENE.glb CAPTURE MAX_SIDE`.
//!
//! Renders with the f64 reference, first with the depth images of the layers, as the composition rule says, then with
//! the rays.

#![allow(clippy::print_stdout, reason = "a program that reports")]

mod held_out;

use std::error::Error;
use std::time::Instant;

use centaur::capture;
use centaur::geometry::MeshBvh;
use centaur::metrics::psnr;
use centaur::render::reference::{Image, render, render_by_mean_rays};
use image::{Rgb, Rgb32FImage};

fn main() -> Result<(), Box<dyn Error>> {
    let held_out::HeldOut { scene, views: held_out, .. } = held_out::open("layer_order")?;
    let (mut sums, mut count) = ([0.0; 2], [0; 4]);
    for view in &held_out {
        let photo = capture::decode(view)?;
        let truth = Rgb32FImage::from_fn(photo.width, photo.height, |x, y| {
            let at = 4 * (y * photo.width + x) as usize;
            Rgb([0, 1, 2].map(|c| f32::from(photo.rgba[at + c]) / 255.0))
        });
        let (by_rays, counts) = render_by_mean_rays(&scene, &view.camera);
        for (sum, image) in sums.iter_mut().zip([&render(&scene, &view.camera), &by_rays]) {
            *sum += psnr(&truth, &picture(image))?;
        }
        for (sum, n) in
            count.iter_mut().zip([counts.splats, counts.outside, counts.different, counts.different_outside])
        {
            *sum += n;
        }
    }
    let views = held_out.len() as f64;
    let [splats, outside, different, different_outside] = count;
    let part = |n: usize| 100.0 * n as f64 / splats.max(1) as f64;
    println!("held-out PSNR by depth images {:.3} dB, by rays {:.3} dB", sums[0] / views, sums[1] / views);
    println!("{splats} splats in front of the cameras, {:.2} % with the mean outside the picture", part(outside));
    println!(
        "in another place of the order at some pixel: {:.2} % inside, {:.2} % outside",
        part(different - different_outside),
        part(different_outside)
    );

    let start = Instant::now();
    let bvh = MeshBvh::new(scene.meshes.iter().map(|mesh| (mesh.positions(), mesh.triangles())));
    let built = start.elapsed();
    let start = Instant::now();
    let mut hits = 0;
    for camera in held_out.iter().map(|view| view.camera.center()) {
        hits += scene.splats.means().iter().map(|p| bvh.all_hits(camera, p.as_dvec3() - camera).len()).sum::<usize>();
    }
    let rays = held_out.len() * scene.splats.len();
    let each = start.elapsed().as_secs_f64() / rays.max(1) as f64;
    println!(
        "hierarchy built in {:.1} ms; {:.2} µs a ray on one core ({hits} hits of {rays} rays)",
        1e3 * built.as_secs_f64(),
        1e6 * each
    );
    Ok(())
}

fn picture(image: &Image) -> Rgb32FImage {
    Rgb32FImage::from_fn(image.width as u32, image.height as u32, |x, y| {
        Rgb(image.rgb[y as usize * image.width + x as usize].map(|c| c as f32))
    })
}
