mod placing;

use std::path::{Component, Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};
use centaur::atomic::{self, Staging, folder_of};
use centaur::edit;
use centaur::format::{
    self, Attribute, Format, FormatError, Loss, ReadOptions, SceneFile, WriteOptions, WriteReport, one_line, spz,
};
use centaur::scene::Composition;
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;

use super::edits::{EditArgs, Edited, Step};
use super::output::counted;
use super::shared::{self, AnimationArgs, MessageArgs};
use super::{output, shell, usage};

const EXAMPLES: &str = "\
Examples:
  centaur convert garden.ply garden.glb
  centaur convert garden.glb splats.ply --no-mesh --no-cameras --strict
  centaur convert table.ply chair.glb room.glb
  centaur convert garden.glb garden.usdz
  mkdir -p mitsuba && centaur convert garden.glb mitsuba/garden.xml
  centaur convert garden.glb garden.blend.py
  centaur convert head.glb mitsuba/smile.xml --time 1.5
  centaur convert fox.glb fox.blend.py --animation Run
  centaur convert scan.ply scan.glb --axes z-up:y-down --scale 0.01
  centaur convert garden.ply small.ply --keep-sphere=0,0,0,3 --decimate 25% --sh-degree 1";

const USAGE: &str = "\
centaur convert [OPTIONS] <INPUT>... <OUTPUT>
       centaur convert [OPTIONS] <INPUT>... -o <OUTPUT>";

/// Convert scenes between formats, and move, crop, thin or join them
///
/// The extension of the output determines its format; .xml is for Mitsuba, and .blend.py is a script that builds the
/// scene in Blender. Lines that begin with `lost:` state what the output format cannot hold; --strict makes such losses
/// an error. Parts removed by options and rounding to 32 bits do not count as losses; a format that cannot hold the
/// record of the training is reported, but is no error.
///
/// Stated errors are the largest over all splats: of positions in units of the scene, of scales in the natural
/// logarithm of a standard deviation (0.01 is 1 %), of opacity and of the colour without higher bands as fractions of
/// the range from 0 to 1. The error of the colour is large if colours lie beyond that range, which formats of 8 bits
/// clip.
///
/// From glTF to glTF, the document itself is written again, with its animations, skins, morph targets, materials,
/// extras and unknown extensions, as long as its scene is complete: moving it without mirroring and --no-cameras keep
/// it so, other edits and joining do not.
///
/// While being edited, scenes are y-down, as in COLMAP and the .ply of INRIA 3DGS; formats that state no coordinate
/// frame are taken to be y-down. glTF and USD are y-up and are rotated on reading and writing. Spherical harmonics
/// rotate with the scene.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES, override_usage = USAGE)]
pub(super) struct Args {
    /// Scenes to read, recognised by content, followed by the file to write unless -o names it
    ///
    /// Several scenes are joined into one, at the highest SH degree among them; the last file must then be new. A file
    /// that an export beside it or a capture uses is not replaced.
    #[arg(required = true, num_args = 1.., value_name = "FILE")]
    files: Vec<PathBuf>,
    /// File to write; all other files are then read, and the file may exist
    #[arg(short, long, value_name = "OUTPUT", value_parser = output::path(writable))]
    output: Option<PathBuf>,
    /// Fail if an input cannot be read exactly, or if the output cannot hold the complete scene
    ///
    /// The record of the training is not part of the scene.
    #[arg(long)]
    strict: bool,
    /// Pose an animated scene at this time; without it, the scene is in its rest pose
    ///
    /// The posed scene has no animations, skins, morph targets or bindings.
    #[arg(long, value_name = "SECONDS", value_parser = shared::seconds, allow_hyphen_values = true)]
    time: Option<f64>,
    #[command(flatten)]
    played: AnimationArgs,
    /// Drop splats with NaN, infinite numbers, negative scales or zero rotations, instead of refusing the file
    ///
    /// Applies to .splat and to .ply that is not compressed; a note names other inputs, on which it has no effect.
    #[arg(long)]
    drop_invalid: bool,
    /// Version of .spz to write; 2 and 3 are for older readers [default: 4]
    #[arg(long, value_name = "2..4", value_parser = clap::value_parser!(u8).range(2..=4))]
    spz_version: Option<u8>,
    #[command(flatten)]
    edits: EditArgs,
    #[command(flatten)]
    messages: MessageArgs,
}

/// Input as reported.
#[derive(Serialize)]
struct Input {
    file: PathBuf,
    splats: usize,
    meshes: usize,
    /// Number of splats left out as invalid.
    dropped: usize,
    notes: Vec<String>,
    /// Whether invalid splats can be left out of this format.
    #[serde(skip)]
    can_drop: bool,
    /// Whether the file has a record of its training.
    #[serde(skip)]
    has_record: bool,
    /// Whether the file states how splats and meshes are blended.
    #[serde(skip)]
    states_composition: bool,
}

/// Result of the conversion, for scripts.
#[derive(Serialize)]
struct Outcome<'a> {
    output: &'a Path,
    bytes: u64,
    splats: usize,
    sh_degree: u32,
    meshes: usize,
    cameras: usize,
    inputs: &'a [Input],
    steps: &'a [Step],
    lossless: bool,
    loss: &'a Loss,
    beside: &'a [String],
    notes: &'a [String],
}

/// Input and output files.
#[derive(Clone, Copy)]
struct Files<'a> {
    inputs: &'a [PathBuf],
    output: &'a Path,
    /// Format of the output.
    format: Format,
}

impl Args {
    /// Input and output files; if no option names the output, it is the last file.
    fn files(&self) -> Result<Files<'_>> {
        let (inputs, output) = match (&self.output, self.files.split_last()) {
            (Some(output), _) => (&self.files[..], output),
            (None, Some((output, inputs))) if !inputs.is_empty() => (inputs, output),
            _ => return Err(usage::wrong("expected files to read and one to write, found one; --help says more")),
        };
        if let Some(pattern) = unexpanded(inputs, cfg!(windows)) {
            let expected = "expected the names of files: this shell does not replace * and ? by them";
            return Err(usage::wrong(format!("{}: {expected}", pattern.display())));
        }
        let format = format_of(output).map_err(|e| usage::wrong(format!("{}: {e}", output.display())))?;
        // Shells may expand `*.ply` so that the last file is an input, which would be overwritten.
        let is_new = self.output.is_some() || inputs.len() == 1 || !output.is_file();
        ensure!(is_new, "{}: exists already: -o {} replaces it", output.display(), shell::argument(output));
        Ok(Files { inputs, output, format })
    }
}

/// First of the inputs with `*` or `?` in its name, which no file has on Windows, where shells leave them as they are.
fn unexpanded(inputs: &[PathBuf], is_windows: bool) -> Option<&Path> {
    let is_pattern =
        |part: Component<'_>| matches!(part, Component::Normal(name) if name.to_string_lossy().contains(['*', '?']));
    inputs.iter().map(PathBuf::as_path).find(|path| is_windows && path.components().any(is_pattern))
}

/// Format in which a file of this name is written.
fn format_of(path: &Path) -> Result<Format, String> {
    let format = Format::of_path(path).filter(|format| format.is_writable());
    format.ok_or_else(|| output::expected_name(&Format::WRITABLE.map(Format::extension)))
}

fn writable(path: PathBuf) -> Result<PathBuf, String> {
    format_of(&path).map(|_| path)
}

pub(super) fn run(args: &Args) -> Result<()> {
    let files = args.files()?;
    usage::demand(
        args.played.animations.is_empty() || args.time.is_some() || files.format == Format::BlendScript,
        "--animation: has no effect on this output without --time: only a .blend.py is animated by it, a glTF keeps all animations, other formats have the rest pose",
    )?;
    usage::demand(
        files.format == Format::Spz || args.spz_version.is_none(),
        format!("{}: --spz-version: expected a name that ends in .spz", files.output.display()),
    )?;
    output::check_file(files.output)?;
    placing::spare_used(files.output)?;
    let bar = output::bar(&args.messages, files.inputs.len() as u64 + 2);
    bar.set_style(
        ProgressStyle::with_template("{bar:16} {pos}/{len}  {wide_msg}").expect("the template is a constant"),
    );
    let (scene, mut inputs) = read(args, files, &bar)?;
    bar.set_message("editing");
    let usual_near = Composition::default().near;
    let has_own_near = scene.scene.composition.near != usual_near;
    let mut edited = args.edits.apply(scene)?;
    if !has_own_near && !files.format.holds_meshes() {
        // Readers of these formats take the default near plane, in whatever unit: scaling loses no near plane of the
        // scene's own.
        edited.scene.composition.near = usual_near;
    }
    if edited.scene.splats.is_empty() && edited.scene.meshes.is_empty() {
        bar.finish_and_clear();
        // They say what was left out, and are otherwise printed with the output, which does not exist here.
        print_notes(&inputs);
        let is_removed = edited.steps.iter().any(|step| step.removed_splats > 0 || step.removed_triangles > 0);
        let why = if is_removed { " after removing" } else { "" };
        bail!("{}: expected something to write, found no splats and no meshes{why}", files.output.display());
    }
    if edited.source.as_ref().is_some_and(|s| files.format.is_gltf() && s.stands(&edited.scene, &edited.cameras)) {
        // A document that is written again is preserved exactly, regardless of what a scene can hold.
        inputs.iter_mut().for_each(|input| input.notes.clear());
    }
    if args.strict
        && let Some((input, note)) = inputs.iter().find_map(|i| Some((i, i.notes.first()?)))
    {
        bail!("{}: --strict: {note}", input.file.display());
    }
    bar.inc(1);
    bar.set_message(format!("writing {}", one_line(&files.output.display().to_string())));
    let replaced = replaced(args, files);
    let mut report = write(args, files, &edited)?;
    // The record of one input is not that of the joined scene.
    report.loss.record |= edited.record.is_none() && inputs.iter().any(|input| input.has_record);
    report.notes.extend(idle(args, &inputs).into_iter().chain(replaced));
    report.notes.extend(larger(files, &edited, report.bytes));
    bar.finish_and_clear();
    let outcome = Outcome {
        output: files.output,
        bytes: report.bytes,
        splats: edited.scene.splats.len(),
        sh_degree: report.loss.sh_degree.map_or(edited.scene.splats.sh_degree(), |[_, kept]| kept),
        meshes: edited.scene.meshes.len() - report.loss.meshes,
        cameras: edited.cameras.len() - report.loss.cameras,
        inputs: &inputs,
        steps: &edited.steps,
        lossless: report.loss.is_rounding() && inputs.iter().all(|i| i.notes.is_empty()),
        loss: &report.loss,
        beside: &report.beside,
        notes: &report.notes,
    };
    if args.messages.json {
        return output::print_json(&outcome);
    }
    print_notes(&inputs);
    report.notes.iter().for_each(|note| output::note(&format!("{}: {note}", files.output.display())));
    output::print_lines(described(&outcome))
}

/// Prints the notes of all inputs.
fn print_notes(inputs: &[Input]) {
    for input in inputs {
        input.notes.iter().for_each(|note| output::note(&format!("{}: {note}", input.file.display())));
    }
}

/// Reads all inputs as one scene in the capture's frame, with notes.
fn read(
    args: &Args,
    Files { inputs: files, format, .. }: Files<'_>,
    bar: &ProgressBar,
) -> Result<(Edited, Vec<Input>)> {
    let one = files.len() == 1;
    let options = ReadOptions {
        drop_invalid: args.drop_invalid,
        keep_document: one && format.is_gltf(),
        time: args.time,
        animations: &args.played.animations,
    };
    let (mut scenes, mut cameras, mut attributes, mut inputs) = (vec![], vec![], vec![], vec![]);
    let (mut document, mut record) = (None, None);
    let mut copyrights: Vec<String> = vec![];
    for file in files {
        bar.set_message(format!("reading {}", one_line(&file.display().to_string())));
        let SceneFile {
            scene,
            states_composition,
            cameras: own,
            mut notes,
            y_up: _,
            attributes: extra,
            dropped,
            source,
            record: own_record,
        } = format::read_file(file, &options)?;
        if let Some(source) = source.as_ref().filter(|_| !one) {
            let parts = source.remainder().iter().map(ToString::to_string);
            let parts = parts.chain(source.extras_of_the_file().map(str::to_owned));
            notes.extend(parts.map(|part| format!("left out on joining: {part}")));
            copyrights.extend(source.copyright().map(str::to_owned).filter(|own| !copyrights.contains(own)));
        }
        let (splats, meshes) = (scene.splats.len(), scene.meshes.len());
        let (can_drop, dropped) = (dropped.is_some(), dropped.unwrap_or(0));
        let has_record = own_record.is_some();
        inputs.push(Input {
            file: file.clone(),
            splats,
            meshes,
            dropped,
            notes,
            can_drop,
            has_record,
            states_composition,
        });
        record = own_record.filter(|_| one);
        scenes.push(scene);
        cameras.extend(own);
        attributes.push(extra);
        document = source.filter(|_| one);
        bar.inc(1);
    }
    let attributes = joined(&attributes, &mut inputs);
    let own: Vec<Composition> = scenes.iter().map(|s| s.composition).collect();
    let scene = if one {
        scenes.remove(0)
    } else {
        let stated = inputs.iter().map(|input| input.states_composition);
        edit::join(scenes.into_iter().zip(stated).collect()).context("joining the inputs")?
    };
    for (input, own) in inputs.iter_mut().zip(&own) {
        let overruled = overruled(input, own, &scene.composition);
        input.notes.extend(overruled.map(|what| format!("left out on joining: its own {what}")));
    }
    let copyright = (!copyrights.is_empty()).then(|| copyrights.join("; "));
    Ok((Edited { scene, cameras, attributes, source: document, record, copyright, steps: vec![] }, inputs))
}

/// Says so where the second of two names, as shells make them of `scene*`, is that of a file, which is gone.
fn replaced(args: &Args, Files { inputs, output, .. }: Files<'_>) -> Option<String> {
    let [input] = inputs else { return None };
    let is_lost = args.output.is_none() && output.is_file() && !output::is_same(input, output);
    is_lost.then(|| "existed before and is replaced: the last file is the one to write".to_owned())
}

/// How many times as large as what it was made of a glTF is that is noted: where pictures of a few kilobytes have
/// become maps, or splats were compressed.
const LARGER: u64 = 10;

/// Says why a glTF that is written anew is so much larger than it was.
fn larger(Files { inputs, format, .. }: Files<'_>, edited: &Edited, bytes: u64) -> Option<String> {
    if edited.scene.meshes.is_empty() || !format.is_gltf() || bytes < 1 << 18 {
        return None;
    }
    // An output may have taken the place of an input, and is as large as itself.
    let before: u64 = inputs.iter().filter_map(|input| format::stored_bytes(input).ok()).sum();
    (bytes >= LARGER * before.max(1)).then(|| {
        format!(
            "is {} times as large as its source: images and splats that are compressed there are stored as floats",
            bytes / before.max(1)
        )
    })
}

/// Says so where `--drop-invalid` is given for inputs that are read whole or not at all.
fn idle(args: &Args, inputs: &[Input]) -> Option<String> {
    let whole = inputs.iter().filter(|input| args.drop_invalid && !input.can_drop);
    let names: Vec<String> = whole.map(|input| input.file.display().to_string()).collect();
    (!names.is_empty()).then(|| {
        let names = format::some_of(names.iter().map(String::as_str));
        format!("--drop-invalid has no effect on {names}: it applies to .splat, and to .ply that is not compressed")
    })
}

/// Note on properties of an input's display that do not apply to the joined scene.
fn overruled(input: &Input, own: &Composition, of_all: &Composition) -> Option<String> {
    let order = |c: &Composition| (c.mode, c.lambda);
    // Most formats do not state the background, and are read with the default.
    let states_background = input.states_composition || own.background != Composition::default().background;
    let parts = [
        ("pixel filter", input.splats > 0 && own.pixel_filter != of_all.pixel_filter),
        ("order of splats and meshes", input.states_composition && input.meshes > 0 && order(own) != order(of_all)),
        ("background", states_background && own.background != of_all.background),
        ("near plane", input.states_composition && own.near != of_all.near),
    ];
    let named: Vec<&str> = parts.iter().filter(|(_, differs)| *differs).map(|(name, _)| *name).collect();
    (!named.is_empty()).then(|| named.join(" and "))
}

/// Joins the attributes that all inputs with splats have, in sequence; notes the others.
fn joined(of_inputs: &[Vec<Attribute>], inputs: &mut [Input]) -> Vec<Attribute> {
    let has_none = inputs.iter().all(|input| input.splats == 0);
    let of_all = of_inputs.iter().zip(inputs.iter());
    let with_splats: Vec<&Vec<Attribute>> =
        of_all.filter(|(_, input)| input.splats > 0 || has_none).map(|(own, _)| own).collect();
    let named = |name: &str| -> Option<Attribute> {
        let parts: Option<Vec<&Attribute>> =
            with_splats.iter().map(|attributes| attributes.iter().find(|a| a.name() == name)).collect();
        Attribute::join(&parts?)
    };
    let mut all: Vec<Attribute> = vec![];
    for (attributes, input) in of_inputs.iter().zip(inputs) {
        for attribute in attributes {
            if all.iter().any(|a| a.name() == attribute.name()) {
                continue;
            }
            match named(attribute.name()) {
                Some(attribute) => all.push(attribute),
                None => input.notes.push(format!("attribute {}: left out, not in all inputs", attribute.name())),
            }
        }
    }
    all
}

/// Writes to a staging folder first: only then is the loss known, and may be rejected.
fn write(args: &Args, Files { inputs, output, format }: Files<'_>, edited: &Edited) -> Result<WriteReport> {
    let named = || format!("{}: cannot write", output.display());
    let place = atomic::place_of(output).with_context(named)?;
    let folder = folder_of(&place);
    let staging = Staging::within(folder).with_context(named)?;
    let staged = staging.path().join(output.file_name().unwrap_or_default());
    let version = match args.spz_version {
        Some(2) => spz::Version::V2,
        Some(3) => spz::Version::V3,
        _ => spz::Version::V4,
    };
    let options = WriteOptions {
        cameras: &edited.cameras,
        attributes: &edited.attributes,
        source: edited.source.as_ref(),
        record: edited.record.as_ref(),
        copyright: edited.copyright.as_deref(),
        spz: spz::Options { version, ..spz::Options::default() },
    };
    let mut report = format::write_scene(&staged, &edited.scene, &options).map_err(|e| match e {
        FormatError::Write { source, .. } => FormatError::Write { file: output.to_owned(), source },
        FormatError::Content { fault, .. } => FormatError::Content { file: output.to_owned(), fault },
        other => other,
    })?;
    let extension = format.extension();
    if edited.scene.splats.is_empty() && report.loss.meshes > 0 {
        bail!("{}: expected splats for a .{extension}, found meshes alone", output.display());
    }
    if args.strict && !report.loss.is_rounding() {
        // Losing the record of the training is acceptable.
        let loss = Loss { record: false, ..report.loss };
        bail!("{}: --strict: a .{extension} would lose {loss}", output.display());
    }
    report.notes.extend(placing::place(&staging, output, &place, inputs)?);
    Ok(report)
}

fn described(o: &Outcome<'_>) -> Vec<String> {
    let mut lines = vec![];
    for input in o.inputs {
        if input.dropped > 0 {
            lines.push(format!("{}: dropped {}", input.file.display(), counted(input.dropped, "invalid splat")));
        }
    }
    for step in o.steps {
        let removed = [(step.removed_splats, "splat"), (step.removed_triangles, "triangle")];
        let removed = removed.into_iter().filter(|(count, _)| *count > 0);
        let removed: Vec<String> = removed.map(|(count, what)| counted(count, what)).collect();
        let removed = if removed.is_empty() { "nothing".to_owned() } else { removed.join(", ") };
        lines.push(format!("{}: removed {removed}", step.step));
    }
    let noted = o.inputs.iter().any(|input| !input.notes.is_empty());
    let also = if noted && o.loss.to_string() == Loss::default().to_string() { ", except as noted" } else { "" };
    lines.push(format!("lost: {}{also}", o.loss));
    let mut parts = vec![format!("{} of SH degree {}", counted(o.splats, "splat"), o.sh_degree)];
    for (count, what) in [(o.meshes, "mesh(es)"), (o.cameras, "camera(s)")] {
        if count > 0 {
            parts.push(format!("{count} {what}"));
        }
    }
    let in_all = if o.beside.is_empty() { "" } else { " in all" };
    lines.push(format!("{}: {}, {} bytes{in_all}", o.output.display(), parts.join(", "), o.bytes));
    if !o.beside.is_empty() {
        lines.push(format!("beside it: {}", o.beside.join(", ")));
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_are_no_names_on_windows() {
        let inputs = ["a.ply", "b/*.ply", "?.ply"].map(PathBuf::from);
        assert_eq!(unexpanded(&inputs, true), Some(Path::new("b/*.ply")));
        assert_eq!([unexpanded(&inputs, false), unexpanded(&inputs[..1], true)], [None, None]);
    }
}
