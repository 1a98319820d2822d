use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use centaur::format::{atomic_write, gltf, read_scene};
use centaur::metrics::to_rgb8;
use centaur::render::gpu::Renderer;
use centaur::scene::color::{linear_to_srgb, srgb_to_linear};
use centaur::scene::{Camera, ColorSpace};
use clap::ValueEnum;
use image::Rgb32FImage;

use super::eval::write_png;
use super::output;
use super::shared::{self, AdapterArgs, CaptureArgs, MessageArgs};

const EXAMPLES: &str = "\
Examples:
  centaur render garden.glb -o frames
  centaur render garden.glb --cameras captures/garden --downscale 4 -o frames
  centaur render garden.glb --cameras orbit/transforms.json --format exr -o frames";

/// Render a scene from given cameras
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// Scene to render: .glb or .gltf, or splats alone in any format that `centaur convert` reads
    #[arg(value_name = "SCENE")]
    scene: PathBuf,
    /// `embedded` (cameras in the scene's file), or a capture: its folder or a transforms*.json
    #[arg(long, value_name = "embedded|CAPTURE", default_value = "embedded")]
    cameras: PathBuf,
    /// Folder for the pictures, named after the cameras
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Kind of picture
    #[arg(long, value_enum, default_value_t = Format::Png)]
    format: Format,
    #[command(flatten)]
    adapter: AdapterArgs,
    #[command(flatten)]
    loading: CaptureArgs,
    #[command(flatten)]
    messages: MessageArgs,
}

#[derive(Clone, Copy, ValueEnum)]
enum Format {
    /// 8 bits, sRGB
    Png,
    /// 32-bit float, linear light, Rec. 709 primaries
    Exr,
}

pub(super) fn run(args: &Args) -> Result<()> {
    output::check_folder(&args.output)?;
    let (scene, cameras): (_, Vec<(String, Camera)>) = if args.cameras == Path::new("embedded") {
        let has_none = || format!("{}: holds no cameras: say --cameras CAPTURE", args.scene.display());
        let is_ply = args.scene.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply"));
        ensure!(!is_ply, has_none());
        let file = gltf::read(&args.scene)?;
        ensure!(!file.cameras.is_empty(), has_none());
        (file.scene, file.cameras)
    } else {
        let capture = args.loading.open(&args.cameras)?;
        (read_scene(&args.scene)?, capture.views.into_iter().map(|v| (v.name, v.camera)).collect())
    };
    let gpu = args.adapter.open()?;
    let poses: Vec<Camera> = cameras.iter().map(|(_, camera)| *camera).collect();
    let mut renderer = Renderer::new(&gpu, &scene, &poses)?;
    shared::make_folder(&args.output)?;
    let extension = match args.format {
        Format::Png => "png",
        Format::Exr => "exr",
    };
    let names = shared::picture_names(cameras.iter().map(|(name, _)| name.as_str()), extension);
    let written: Vec<PathBuf> = names.iter().map(|name| args.output.join(name)).collect();
    let bar = output::bar(&args.messages, cameras.len() as u64);
    for ((name, camera), path) in cameras.iter().zip(&written) {
        let image = shared::image(renderer.render(camera).with_context(|| name.clone())?);
        write_frame(path, image, args.format, scene.composition.color_space)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    if args.messages.json {
        return output::print_json(&serde_json::json!({ "pictures": written, "adapter": gpu.adapter() }));
    }
    output::print(&format!("{}: {} pictures", args.output.display(), written.len()))
}

fn write_frame(path: &Path, image: Rgb32FImage, format: Format, space: ColorSpace) -> Result<()> {
    match (format, space) {
        (Format::Png, ColorSpace::SrgbDisplay) => write_png(path, &to_rgb8(&image)),
        (Format::Png, ColorSpace::LinearDisplay) => write_png(path, &to_rgb8(&mapped(image, linear_to_srgb))),
        (Format::Exr, ColorSpace::SrgbDisplay) => write_exr(path, &mapped(image, srgb_to_linear)),
        (Format::Exr, ColorSpace::LinearDisplay) => write_exr(path, &image),
    }
}

fn mapped(mut image: Rgb32FImage, f: fn(f32) -> f32) -> Rgb32FImage {
    image.iter_mut().for_each(|v| *v = f(*v));
    image
}

fn write_exr(path: &Path, image: &Rgb32FImage) -> Result<()> {
    use exr::prelude::{Encoding, Image, SpecificChannels, WritableImage as _};
    let (width, height) = image.dimensions();
    let pixels = SpecificChannels::rgb(|at: exr::math::Vec2<usize>| {
        let [r, g, b] = image.get_pixel(at.x() as u32, at.y() as u32).0;
        (r, g, b)
    });
    let exr = Image::from_encoded_channels((width as usize, height as usize), Encoding::SMALL_LOSSLESS, pixels);
    let mut bytes = std::io::Cursor::new(vec![]);
    exr.write().to_buffered(&mut bytes).with_context(|| path.display().to_string())?;
    Ok(atomic_write(path, bytes.get_ref())?)
}

#[cfg(test)]
mod tests {
    use image::Rgb;

    use super::*;

    #[test]
    fn exr_keeps_floats_and_transfer_functions_are_inverse() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        let image = Rgb32FImage::from_fn(5, 3, |x, y| Rgb([x as f32 * 0.3, y as f32 - 0.5, 7.25]));
        write_exr(&path, &image).unwrap();
        let back = exr::prelude::read_first_rgba_layer_from_file(
            &path,
            |size, _| Rgb32FImage::new(size.x() as u32, size.y() as u32),
            |image, at, (r, g, b, _): (f32, f32, f32, f32)| {
                image.put_pixel(at.x() as u32, at.y() as u32, Rgb([r, g, b]));
            },
        );
        assert_eq!(back.unwrap().layer_data.channel_data.pixels, image);
        for c in [0.0_f32, 0.01, 0.5, 1.0] {
            assert!((srgb_to_linear(linear_to_srgb(c)) - c).abs() < 1e-6);
        }
    }
}
