//! Edits by `convert` between reading and writing: options, and the fixed order in which they are applied.

use anyhow::{Context as _, Result};
use centaur::edit::{self, Axes, Crop, Similarity, Volume};
use centaur::format::Attribute;
use centaur::format::gltf::Source;
use centaur::scene::{self, Camera, HybridScene, Splats};
use glam::{DMat3, DQuat, DVec3, EulerRot};
use serde::Serialize;

const MOVE: &str = "1. Move (in this order)";
const CROP: &str = "2. Crop (in coordinates of the moved scene, y-down as above)";
const THIN: &str = "3. Thin out";

/// Changes to a scene. They are applied in the order of `--help`, whatever the order on the command line.
#[derive(clap::Args)]
pub(super) struct EditArgs {
    /// Convert coordinates from one frame to another, mirroring the scene if their handedness differs
    ///
    /// A frame is y-down (colmap), y-up (gltf), z-up (blender), unity, unreal, or three letters for the directions of
    /// x, y and z, such as RDF for right, down, forward.
    #[arg(long, value_name = "FROM:TO", value_parser = axes, help_heading = MOVE)]
    axes: Option<DMat3>,
    /// Scale about the origin by this factor
    #[arg(long, value_name = "S", value_parser = positive, allow_hyphen_values = true, help_heading = MOVE)]
    scale: Option<f64>,
    /// Rotate about the origin, by degrees about x, then about y, then about z, right-handed
    #[arg(long, value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true, help_heading = MOVE)]
    rotate: Option<DVec3>,
    /// Translate by this vector
    #[arg(long, value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true, help_heading = MOVE)]
    translate: Option<DVec3>,

    /// Keep only what lies in this box, given by its lower and upper corner; `inf` and `-inf` leave a side open
    #[arg(long, value_name = "X,Y,Z,X,Y,Z", value_parser = cuboid, allow_hyphen_values = true, help_heading = CROP)]
    keep_box: Vec<Volume>,
    /// Keep only what lies in this sphere, given by its centre and radius
    #[arg(long, value_name = "X,Y,Z,R", value_parser = sphere, allow_hyphen_values = true, help_heading = CROP)]
    keep_sphere: Vec<Volume>,
    /// Remove what lies in this box, given by its lower and upper corner
    #[arg(long, value_name = "X,Y,Z,X,Y,Z", value_parser = cuboid, allow_hyphen_values = true, help_heading = CROP)]
    remove_box: Vec<Volume>,
    /// Remove what lies in this sphere, given by its centre and radius
    ///
    /// All four crop options may be repeated: the remaining scene lies in all volumes to keep and in none to remove. A
    /// splat is located at its mean, a triangle at its centroid.
    #[arg(long, value_name = "X,Y,Z,R", value_parser = sphere, allow_hyphen_values = true, help_heading = CROP)]
    remove_sphere: Vec<Volume>,

    /// Remove the meshes and keep the splats
    #[arg(long, help_heading = THIN)]
    no_mesh: bool,
    /// Remove the cameras
    #[arg(long, help_heading = THIN)]
    no_cameras: bool,
    /// Remove splats with an opacity below this value
    #[arg(long, value_name = "0..1", value_parser = share, help_heading = THIN)]
    min_opacity: Option<f64>,
    /// Keep only the N splats, or the fraction N%, with the largest product of opacity and area of the largest section
    /// of the ellipsoid
    #[arg(long, value_name = "N|N%", value_parser = amount, help_heading = THIN)]
    decimate: Option<Amount>,
    /// Drop spherical harmonics above this degree, from splats and texture maps
    #[arg(long, value_name = "0..3", value_parser = clap::value_parser!(u32).range(0..=3), help_heading = THIN)]
    sh_degree: Option<u32>,
    /// Sort splats along a Morton curve, which stores neighbours together, for better compression and faster rendering
    #[arg(long, help_heading = THIN)]
    morton: bool,
}

/// Effect of one edit step, for the record.
#[derive(Debug, Serialize)]
pub(super) struct Step {
    /// Option of the step.
    pub(super) step: &'static str,
    /// Number of splats removed.
    pub(super) removed_splats: usize,
    /// Number of triangles removed.
    pub(super) removed_triangles: usize,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Amount {
    Count(usize),
    Share(f64),
}

/// Scene between input and output.
pub(super) struct Edited {
    pub(super) scene: HybridScene,
    pub(super) cameras: Vec<(String, Camera)>,
    /// Further per-splat attributes.
    pub(super) attributes: Vec<Attribute>,
    /// glTF document from which the scene was read.
    pub(super) source: Option<Source>,
    /// Record of the training, if there is one.
    pub(super) record: Option<serde_json::Value>,
    /// Copyright of a scene joined of several.
    pub(super) copyright: Option<String>,
    pub(super) steps: Vec<Step>,
}

impl EditArgs {
    /// Applies the requested edits.
    pub(super) fn apply(&self, scene: Edited) -> Result<Edited> {
        let mut edited = scene.moved(&self.similarity()?)?;
        let crops: Vec<Crop> = (self.keep_box.iter().chain(&self.keep_sphere).map(|v| Crop::Inside(*v)))
            .chain(self.remove_box.iter().chain(&self.remove_sphere).map(|v| Crop::Outside(*v)))
            .collect();
        if !crops.is_empty() {
            edited.keep("crop", &edit::in_crops(&edited.scene.splats, &crops), |meshes| {
                *meshes = meshes.iter().filter_map(|m| edit::crop_mesh(m, &crops)).collect();
            });
        }
        if self.no_mesh {
            let all: Vec<usize> = (0..edited.scene.splats.len()).collect();
            edited.keep("no-mesh", &all, Vec::clear);
        }
        if let Some(opacity) = self.min_opacity {
            edited.keep("min-opacity", &edit::not_below_opacity(&edited.scene.splats, opacity), |_| ());
        }
        if let Some(amount) = self.decimate {
            let count = amount.of(edited.scene.splats.len());
            edited.keep("decimate", &edit::most_important(&edited.scene.splats, count), |_| ());
        }
        if self.no_cameras {
            edited.cameras.clear();
            edited.source.iter_mut().for_each(Source::forget_cameras);
        }
        if let Some(degree) = self.sh_degree {
            let HybridScene { splats, meshes, composition } = edited.scene;
            let cut = degree.min(splats.sh_degree());
            let splats = edit::with_sh_degree(splats, cut);
            let meshes = meshes.into_iter().map(|m| edit::with_mesh_sh_degree(m, degree)).collect();
            edited.scene = HybridScene { splats, meshes, composition };
        }
        if self.morton {
            edited.gather(&scene::in_morton_order(&edited.scene.splats));
        }
        Ok(edited)
    }

    fn similarity(&self) -> Result<Similarity> {
        let turn = self.rotate.map_or(DMat3::IDENTITY, |degrees| {
            let [x, y, z] = degrees.to_array().map(f64::to_radians);
            DMat3::from_quat(DQuat::from_euler(EulerRot::ZYX, z, y, x))
        });
        let axes = Similarity::new(1.0, self.axes.unwrap_or(DMat3::IDENTITY), DVec3::ZERO)?;
        let rest = Similarity::new(self.scale.unwrap_or(1.0), turn, self.translate.unwrap_or(DVec3::ZERO))?;
        Ok(axes.then(&rest))
    }
}

impl Edited {
    /// The scene and its cameras, moved together.
    fn moved(self, by: &Similarity) -> Result<Self> {
        if *by == Similarity::IDENTITY {
            return Ok(self);
        }
        let scene = by.scene(self.scene).context("moving the scene")?;
        let camera = |(name, camera): (String, Camera)| {
            let moved = by.camera(&camera).with_context(|| format!("moving camera {name}"))?;
            Ok((name, moved))
        };
        let cameras = self.cameras.into_iter().map(camera).collect::<Result<Vec<_>>>()?;
        let source = self.source.map(|mut source| {
            source.follow(by.matrix(), &scene, &cameras);
            source
        });
        Ok(Self { scene, cameras, source, ..self })
    }

    /// Selects the splats of these indices, with their attributes.
    fn gather(&mut self, indices: &[usize]) {
        let splats = std::mem::replace(&mut self.scene.splats, Splats::empty(0));
        self.scene.splats = scene::gather(splats, indices);
        self.attributes.iter_mut().for_each(|a| *a = a.gather(indices));
    }

    fn keep(&mut self, step: &'static str, splats: &[usize], meshes: impl FnOnce(&mut Vec<scene::Mesh>)) {
        let triangles = |scene: &HybridScene| scene.meshes.iter().map(|m| m.triangles().len()).sum::<usize>();
        let removed_splats = self.scene.splats.len() - splats.len();
        if removed_splats > 0 {
            self.gather(splats);
        }
        let before = triangles(&self.scene);
        meshes(&mut self.scene.meshes);
        let removed_triangles = before - triangles(&self.scene);
        self.steps.push(Step { step, removed_splats, removed_triangles });
    }
}

impl Amount {
    fn of(self, total: usize) -> usize {
        match self {
            Self::Count(count) => count,
            Self::Share(share) => (share * total as f64).round() as usize,
        }
    }
}

fn axes(text: &str) -> Result<DMat3, String> {
    let (from, to) = text.split_once(':').ok_or("expected two frames, FROM:TO, such as z-up:y-down")?;
    Ok(from.parse::<Axes>()?.to(to.parse()?))
}

fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let parsed: Option<Vec<f64>> =
        text.split(',').map(|n| n.trim().parse().ok().filter(|n: &f64| !n.is_nan())).collect();
    let parsed = parsed.and_then(|n| <[f64; N]>::try_from(n).ok());
    parsed.ok_or_else(|| format!("expected {N} numbers separated by commas"))
}

pub(super) fn finite<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let numbers = numbers(text)?;
    if numbers.iter().all(|n| n.is_finite()) { Ok(numbers) } else { Err("expected finite numbers".to_owned()) }
}

pub(super) fn point(text: &str) -> Result<DVec3, String> {
    finite(text).map(DVec3::from_array)
}

fn cuboid(text: &str) -> Result<Volume, String> {
    let [a, b, c, d, e, f] = numbers(text)?;
    let (low, high) = (DVec3::new(a, b, c), DVec3::new(d, e, f));
    if low.cmple(high).all() {
        Ok(Volume::Box { low, high })
    } else {
        Err("expected a lower corner that is nowhere above the upper".to_owned())
    }
}

fn sphere(text: &str) -> Result<Volume, String> {
    let [x, y, z, radius] = finite(text)?;
    if radius >= 0.0 {
        Ok(Volume::Sphere { center: DVec3::new(x, y, z), radius })
    } else {
        Err("expected a radius of at least 0".to_owned())
    }
}

pub(super) fn positive(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|n: &f64| *n > 0.0 && n.is_finite()).ok_or_else(|| "expected a number above 0".to_owned())
}

fn share(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|n: &f64| (0.0..=1.0).contains(n))
        .ok_or_else(|| "expected a number from 0 to 1".to_owned())
}

fn amount(text: &str) -> Result<Amount, String> {
    let expected = || "expected a number of splats, or a share such as 25%".to_owned();
    match text.strip_suffix('%') {
        Some(percent) => {
            let percent = percent.parse().ok().filter(|p: &f64| (0.0..=100.0).contains(p)).ok_or_else(expected)?;
            Ok(Amount::Share(0.01 * percent))
        }
        None => text.parse().map(Amount::Count).map_err(|_| expected()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_are_about_x_then_y_then_z() {
        use clap::{Args as _, FromArgMatches as _};
        let command = EditArgs::augment_args(clap::Command::new("convert"));
        let given = ["convert", "--rotate", "-90,90,0", "--scale=2", "--translate", "-1,0,0.5", "--axes", "y-up:z-up"];
        let args = EditArgs::from_arg_matches(&command.get_matches_from(given)).unwrap();
        // (0, 1, 0) in y-up is (0, 0, 1) in z-up; −90° about x takes it to (0, 1, 0), and 90° about y leaves it there.
        let moved = args.similarity().unwrap().point(DVec3::Y);
        assert!(moved.abs_diff_eq(DVec3::new(-1.0, 2.0, 0.5), 1e-12), "{moved}");
    }

    #[test]
    fn amounts_are_counts_or_shares() {
        assert_eq!((amount("10").unwrap().of(4), amount("25%").unwrap().of(10)), (10, 3));
        for text in ["", "-1", "1.5", "101%", "nan%", "%"] {
            assert!(amount(text).is_err(), "{text}");
        }
        for text in ["1,2", "1,2,3,4", "1,2,nan", "a,b,c", "1,2,inf"] {
            assert!(point(text).is_err(), "{text}");
        }
        assert!(cuboid("-inf,-inf,0,inf,inf,1").is_ok() && cuboid("0,0,0,1,-1,1").is_err());
        assert!(
            sphere("0,0,0,-1").is_err() && positive("0").is_err() && positive("inf").is_err() && share("1.1").is_err()
        );
        assert!(axes("y-up").is_err() && axes("y-up:up").is_err() && axes("RDF:gltf").is_ok());
    }
}
