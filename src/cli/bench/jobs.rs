//! Jobs of a benchmark.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail};
use centaur::capture;
use centaur::format::is_device;
use serde::{Deserialize, Serialize};

use super::Args;
use super::flags::{OF_JOBS, OF_SIZE, WEIGHTS, as_kept, chooses_pictures, is_one_of, left_of};
use super::protocol::{MIPNERF360, Protocol, size_of};
use super::scenes::{Scene, scenes};
use crate::cli::usage;

/// Note on scenes of Mip-NeRF 360 whose photographs nothing downscales: they have up to 17 megapixels, for which no
/// table exists.
pub(super) fn of_full_size(jobs: &[&Job]) -> Option<String> {
    let is_known = |scene: &str| MIPNERF360.iter().any(|(name, _)| *name == scene);
    let is_sized = |job: &Job| job.given().any(|flag| is_one_of(flag, &OF_SIZE) || is_one_of(flag, &["--images"]));
    let full = jobs.iter().filter(|job| job.protocol.is_none() && is_known(&job.scene) && !is_sized(job));
    let scenes: BTreeSet<&str> = full.map(|job| job.scene.as_str()).collect();
    (!scenes.is_empty()).then(|| {
        let scenes = scenes.into_iter().collect::<Vec<_>>().join(", ");
        format!(
            "{scenes}: trained at full size, which takes long and has no published results: --protocol a or b uses the published sizes"
        )
    })
}

/// Training variant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Variant {
    name: String,
    flags: Vec<String>,
}

/// How a result was made.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Made {
    pub(super) variant: String,
    pub(super) scene: String,
    pub(super) seed: u64,
    /// See [`centaur::capture::fingerprint`].
    #[serde(default)]
    pub(super) capture: Option<u32>,
    /// Of `centaur train`, for the scene.
    #[serde(default)]
    pub(super) scene_flags: Vec<String>,
    /// Of `centaur train`, for all scenes of the variant, without those that every job has and those of the protocol.
    pub(super) flags: Vec<String>,
    pub(super) protocol: Option<Protocol>,
    /// Jobs that shared the machine; 0 if that is unknown, or was not the same in all runs of this one. Only the times
    /// of 1 are times of a job.
    pub(super) at_a_time: usize,
}

impl Made {
    /// Where the result is, in the folder of all.
    pub(super) fn place(&self) -> PathBuf {
        Path::new(&self.variant).join(format!("{}-{}.json", self.scene, self.seed))
    }
}

/// A part of the jobs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Shard {
    index: usize,
    of: usize,
}

/// One training with its evaluation.
#[derive(Clone, Debug)]
pub(super) struct Job {
    pub(super) scene: String,
    pub(super) variant: String,
    pub(super) seed: u64,
    pub(super) capture: PathBuf,
    pub(super) protocol: Option<Protocol>,
    /// Flags of the scene, from `scenes.json`.
    scene_flags: Vec<String>,
    /// Flags of the command and the variant, which replace those of the scene.
    flags: Vec<String>,
    /// Path of the result, written when the job is done.
    pub(super) result: PathBuf,
}

/// Parses `NAME` or `NAME=FLAGS`; for clap's `value_parser`.
pub(super) fn variant(text: &str) -> Result<Variant, String> {
    let (name, flags) = text.split_once('=').unwrap_or((text, ""));
    let safe = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    if name.is_empty() || name.starts_with('-') || !name.chars().all(safe) {
        return Err(format!("expected a name of letters, digits, - and _, and after = flags, found `{text}`"));
    }
    if is_device(name) {
        return Err(format!("expected another name: on Windows, {name} is a device"));
    }
    Ok(Variant { name: name.to_owned(), flags: flags.split_whitespace().map(str::to_owned).collect() })
}

/// Parses `I/N`; for clap's `value_parser`.
pub(super) fn shard(text: &str) -> Result<Shard, String> {
    let parts = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
    match parts {
        Some((index, of)) if index < of => Ok(Shard { index, of }),
        _ => Err("expected I/N with I from 0 to N − 1, such as 0/4".to_owned()),
    }
}

/// All combinations of scene, variant and seed.
pub(super) fn all(args: &Args) -> Result<Vec<Job>> {
    let scenes = scenes(&args.dataset, args.messages.json)?;
    if let Some(missing) = args.scenes.iter().find(|name| !scenes.contains_key(*name)) {
        let found: Vec<&str> = scenes.keys().map(String::as_str).collect();
        bail!("{}: expected a scene `{missing}`, found {}", args.dataset.display(), found.join(", "));
    }
    let usual = [Variant { name: "default".to_owned(), flags: vec![] }];
    let variants = if args.variants.is_empty() { &usual[..] } else { &args.variants };
    for (i, variant) in variants.iter().enumerate() {
        // Folders whose names differ by case alone are one on many systems.
        let Some(twin) = variants[..i].iter().find(|v| v.name.eq_ignore_ascii_case(&variant.name)) else { continue };
        let said = if twin.name == variant.name { "given twice" } else { "given before in another case" };
        return Err(usage::wrong(format!("--variant {}: {said}", variant.name)));
    }
    if let Some(protocol) = args.protocol {
        let mut given = args.flags.iter().chain(variants.iter().flat_map(|variant| &variant.flags));
        let given = given.find(|flag| chooses_pictures(flag));
        if let Some(flag) = given {
            return Err(usage::wrong(format!(
                "--protocol {protocol}: expected no flag for the pictures, which it decides, found `{flag}`"
            )));
        }
        // Scenes with other names are used as they are, with their own flags.
        let decides = |name: &str| !size_of(name, protocol).is_empty();
        let mut of_scenes = scenes
            .iter()
            .filter(|(name, _)| decides(name))
            .flat_map(|(name, s)| s.flags.iter().map(move |flag| (name, flag)));
        if let Some((name, flag)) = of_scenes.find(|(_, flag)| chooses_pictures(flag)) {
            bail!(
                "--protocol {protocol}: expected scenes.json without flags for the pictures of {name}, which it decides, found `{flag}`"
            );
        }
    }
    for (i, seed) in args.seeds.iter().enumerate() {
        usage::demand(!args.seeds[..i].contains(seed), format!("--seeds: {seed} given twice"))?;
    }
    let wanted = scenes.into_iter().filter(|(name, _)| args.scenes.is_empty() || args.scenes.contains(name));
    Ok(wanted
        .flat_map(|(scene, Scene { capture, flags: of_scene })| {
            let capture = args.dataset.join(capture);
            variants.iter().flat_map(move |variant| {
                let flags = [args.flags.clone(), variant.flags.clone()].concat();
                let (scene, capture, of_scene) = (scene.clone(), capture.clone(), left_of(&of_scene, &flags));
                args.seeds.iter().map(move |&seed| Job {
                    result: args.output.join(&variant.name).join(format!("{scene}-{seed}.json")),
                    variant: variant.name.clone(),
                    seed,
                    scene: scene.clone(),
                    capture: capture.clone(),
                    protocol: args.protocol,
                    scene_flags: of_scene.clone(),
                    flags: flags.clone(),
                })
            })
        })
        .collect())
}

/// Jobs selected by `--only` and `--shard`.
pub(super) fn chosen<'j>(all: &'j [Job], args: &Args) -> Result<Vec<&'j Job>> {
    if let Some(unknown) = args.only.iter().find(|name| all.iter().all(|job| job.name() != **name)) {
        bail!("--only {unknown}: expected one of the {} jobs of --list, found none of that name", all.len());
    }
    let shard = args.shard.unwrap_or(Shard { index: 0, of: 1 });
    let mine = all.iter().filter(|job| args.only.is_empty() || args.only.contains(&job.name()));
    Ok(mine.skip(shard.index).step_by(shard.of).collect())
}

impl Job {
    /// Name of the job, `VARIANT/SCENE-SEED`.
    pub(super) fn name(&self) -> String {
        format!("{}/{}-{}", self.variant, self.scene, self.seed)
    }

    /// Flags given by the user; later ones take precedence.
    fn given(&self) -> impl Iterator<Item = &String> {
        self.scene_flags.iter().chain(&self.flags)
    }

    /// Checkpoint from which the job resumes.
    pub(super) fn checkpoint(&self) -> PathBuf {
        self.result.with_extension("glb.checkpoint")
    }

    /// Whether a checkpoint exists.
    pub(super) fn is_begun(&self) -> bool {
        self.checkpoint().is_file()
    }

    /// Arguments with which this program trains. Flags that every job sets come last, where nothing overrides them.
    pub(super) fn command(&self) -> Vec<OsString> {
        let scene = self.result.with_extension("glb");
        let resume = self.is_begun().then(|| "--resume".to_owned());
        let size = self.protocol.map_or(vec![], |protocol| size_of(&self.scene, protocol));
        let mut command = vec!["train".into(), self.capture.clone().into_os_string()];
        command.extend(size.iter().chain(self.given()).map(OsString::from));
        command.extend(["-o".into(), scene.into_os_string()]);
        command.extend(["--report".into(), self.result.with_extension("").into_os_string()]);
        command.extend(["--seed".into(), self.seed.to_string().into()]);
        command.extend(["--json", "--quiet", "--stop-at-eof"].map(OsString::from));
        command.extend(resume.map(OsString::from));
        command
    }

    /// Arguments with which this program does only this job.
    pub(super) fn listed(&self, args: &Args) -> Vec<OsString> {
        let mut words = vec!["bench".into(), args.dataset.clone().into_os_string()];
        words.extend(["-o".into(), args.output.clone().into_os_string()]);
        if let Some(variant) = args.variants.iter().find(|v| v.name == self.variant) {
            words.extend(["--variant".into(), format!("{}={}", variant.name, variant.flags.join(" ")).into()]);
        }
        words.extend(["--seeds".into(), self.seed.to_string().into()]);
        if let Some(protocol) = self.protocol {
            words.extend(["--protocol".into(), protocol.to_string().into()]);
        }
        words.extend(["--beside-others".into(), "--only".into(), self.name().into()]);
        if !args.flags.is_empty() {
            words.extend(std::iter::once("--".to_owned()).chain(args.flags.iter().cloned()).map(OsString::from));
        }
        words
    }

    /// Fingerprint ([`capture::fingerprint`]) of the capture with the photographs in the folder that [`images_of`]
    /// names. Errors of reading are reported by the training.
    pub(super) fn fingerprint(&self, images: Option<&str>) -> Option<u32> {
        capture::fingerprint(&self.capture, images).ok().flatten()
    }

    /// Metadata for the result, without the capture's fingerprint.
    pub(super) fn made(&self, at_a_time: usize) -> Made {
        Made {
            variant: self.variant.clone(),
            scene: self.scene.clone(),
            seed: self.seed,
            capture: None,
            scene_flags: as_kept(&self.scene_flags),
            flags: as_kept(&self.flags),
            protocol: self.protocol,
            at_a_time,
        }
    }

    /// Whether the job's flags name LPIPS weights.
    pub(super) fn scores_lpips(&self) -> bool {
        self.given().any(|flag| flag.starts_with(WEIGHTS))
    }

    /// Checks that `centaur train` accepts the flags, and that none is one that jobs set themselves.
    pub(super) fn check(&self) -> Result<()> {
        let own = self.given().find(|flag| is_one_of(flag, &OF_JOBS));
        if let Some(flag) = own {
            return Err(usage::wrong(format!(
                "flags of {}: expected none that every job has of its own (-o, --seeds of this command), found `{flag}`",
                self.name()
            )));
        }
        let parsed = crate::cli::Cli::of(std::iter::once("centaur".into()).chain(self.command()));
        let wrong = |e: clap::Error| {
            // Flags that print something else, such as help, are no errors to clap.
            usage::wrong(if e.use_stderr() {
                first_line(&e)
            } else {
                "expected those of a training, found one that prints help".to_owned()
            })
        };
        parsed.map(drop).map_err(wrong).with_context(|| format!("flags of {}", self.name()))
    }
}

/// First line of clap's message, which states the error. Advice and usage follow.
fn first_line(error: &clap::Error) -> String {
    let text = error.to_string();
    let line = text.lines().next().unwrap_or_default();
    line.strip_prefix("error: ").unwrap_or(line).to_owned()
}

/// Folder of photographs that the flags name.
pub(super) fn images_of(made: &Made) -> Option<String> {
    let size = made.protocol.map_or(vec![], |protocol| size_of(&made.scene, protocol));
    let flags: Vec<&str> = size.iter().chain(&made.scene_flags).chain(&made.flags).map(String::as_str).collect();
    let apart = flags.windows(2).filter(|pair| pair[0] == "--images").map(|pair| pair[1]);
    let joined = flags.iter().filter_map(|flag| flag.strip_prefix("--images="));
    // A flag given again replaces the former; both spellings are not mixed in practice.
    apart.chain(joined).last().map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;

    use clap::Parser as _;
    use serde_json::Value;

    use super::*;
    use crate::cli::bench::record::{self, Record};
    use crate::cli::{Cli, Command};

    fn args(dataset: &Path, more: &[&str]) -> Box<Args> {
        let fixed = ["centaur", "bench", dataset.to_str().unwrap(), "-o", "out"];
        match Cli::try_parse_from(fixed.iter().chain(more)).unwrap().command {
            Command::Bench(args) => args,
            _ => unreachable!(),
        }
    }

    fn dataset(scenes: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for scene in scenes {
            let model = folder.path().join(scene).join("sparse/0");
            std::fs::create_dir_all(&model).unwrap();
            std::fs::write(model.join("cameras.bin"), []).unwrap();
        }
        std::fs::create_dir(folder.path().join("notes")).unwrap();
        folder
    }

    /// Other systems do not allow such file names.
    #[cfg(unix)]
    #[test]
    fn names_fit_a_line() {
        let folder = dataset(&["a b's", "a\nb", "a\u{c}b", ".kept"]);
        assert_eq!(scenes(folder.path(), false).unwrap().into_keys().collect::<Vec<_>>(), ["a b's"]);
    }

    #[test]
    fn every_scene_variant_and_seed_is_one_job() {
        let folder = dataset(&["room", "garden", "mine"]);
        let more = [
            "--variant",
            "hybrid",
            "--variant",
            "splats=--no-mesh --max-splats 500",
            "--seeds",
            "0,7",
            "--protocol",
            "b",
            "--",
            "--antialias",
            "--max-splats",
            "9",
        ];
        let args = args(folder.path(), &more);
        let all = all(&args).unwrap();
        let names: Vec<String> = all.iter().map(Job::name).collect();
        assert_eq!(names[..4], ["hybrid/garden-0", "hybrid/garden-7", "splats/garden-0", "splats/garden-7"]);
        assert_eq!(names.len(), 12);
        let joined = |words: Vec<OsString>| words.join(OsStr::new(" ")).into_string().unwrap().replace('\\', "/");
        let line = |i: usize| joined(all[i].command());
        // Flags of the job, followed by those that no other flag overrides.
        let expected = "garden --downscale 4 --antialias --max-splats 9 --no-mesh --max-splats 500 -o out/splats/garden-7.glb \
                        --report out/splats/garden-7 --seed 7 --json --quiet --stop-at-eof";
        assert!(line(3).ends_with(expected), "{}", line(3));
        assert!(line(4).contains("mine --antialias --max-splats 9 -o "), "{}", line(4));
        assert!(line(8).contains("--downscale 2"), "{}", line(8));
        let free = Args { protocol: None, ..*self::args(folder.path(), &more) };
        assert!(super::all(&free).unwrap().iter().all(|job| !joined(job.command()).contains("downscale")));
        // The listed command runs that job alone, whatever other jobs this command was given.
        for job in &all {
            let words = std::iter::once("centaur".into()).chain(job.listed(&args));
            let Command::Bench(again_args) = Cli::try_parse_from(words).unwrap().command else { unreachable!() };
            let jobs = super::all(&again_args).unwrap();
            let again = chosen(&jobs, &again_args).unwrap();
            assert_eq!(again.len(), 1);
            assert_eq!((again[0].name(), again[0].command()), (job.name(), job.command()));
            assert!(again_args.shares_machine() && !args.shares_machine());
        }
        all.iter().for_each(|job| job.check().unwrap());
        // Shards are disjoint, and together contain all jobs.
        let mut shared: Vec<String> = (0..5)
            .flat_map(|i| {
                let args = Args { shard: Some(Shard { index: i, of: 5 }), ..*self::args(folder.path(), &more) };
                assert!(args.shares_machine());
                chosen(&all, &args).unwrap().into_iter().map(Job::name).collect::<Vec<_>>()
            })
            .collect();
        shared.sort();
        let mut sorted = names.clone();
        sorted.sort();
        assert_eq!(shared, sorted);
    }

    #[test]
    fn a_list_of_scenes_says_where_they_are_and_how_they_train() {
        let folder = dataset(&["more/Barn", "tandt/truck", "stray"]);
        let list = folder.path().join("scenes.json");
        let write = |text: &str| std::fs::write(&list, text).unwrap();
        write(
            r#"{"scenes": {"truck": {"capture": "tandt/truck"},
                           "Barn": {"capture": "more/Barn", "flags": ["--downscale", "2"]}}}"#,
        );
        let all = all(&args(folder.path(), &["--", "--antialias"])).unwrap();
        assert_eq!(all.iter().map(Job::name).collect::<Vec<_>>(), ["default/Barn-0", "default/truck-0"]);
        assert_eq!(all[0].scene_flags, ["--downscale", "2"]);
        for size in ["--max-side=64", "--downscale=4"] {
            let sized = super::all(&args(folder.path(), &["--", size])).unwrap();
            assert!(sized.iter().all(|job| job.scene_flags.is_empty() && job.flags == [size]));
            sized.iter().for_each(|job| job.check().unwrap());
        }
        let words = all[0].command();
        let at = words.iter().position(|word| word == "--downscale").unwrap();
        assert_eq!(words[at..at + 3], ["--downscale", "2", "--antialias"], "the command's replace those of the scene");
        assert_eq!((&all[1].capture, all[1].given().count()), (&folder.path().join("tandt/truck"), 1));
        all.iter().for_each(|job| job.check().unwrap());
        // The results of all jobs belong to one variant; once the list has other flags for a scene, its results do not.
        let mut records: Vec<Record> = (all.iter())
            .map(|job| Record { file: job.result.clone(), made: job.made(1), result: Value::Null })
            .collect();
        record::check(&records, &all).unwrap();
        records[0].made.scene_flags.clear();
        let found = record::check(&records, &all).unwrap_err().to_string().replace('\\', "/");
        assert!(found.starts_with("out/default/Barn-0.json: expected a result of the flags of Barn in"), "{found}");
        let error = |text: &str| {
            write(text);
            format!("{:#}", super::all(&args(folder.path(), &["--protocol", "b"])).unwrap_err())
        };
        for capture in ["../elsewhere", "/tmp", "", "tandt/../../x"] {
            let found = error(&format!(r#"{{"scenes": {{"a": {{"capture": "{capture}"}}}}}}"#));
            assert!(found.contains("scenes.json: expected the folder of a within its own"), "{found}");
        }
        assert!(error(r#"{"scenes": {"a/b": {"capture": "tandt/truck"}}}"#).contains("found `a/b`"));
        let twins = error(r#"{"scenes": {"a": {"capture": "tandt/truck"}, "A": {"capture": "more/Barn"}}}"#);
        assert!(twins.ends_with("expected names that differ by more than case, found A and a"), "{twins}");
        assert!(error(r#"{"scenes": {}}"#).contains("expected scenes, found none"));
        for (wrong, found) in [("{", "EOF while parsing"), (r#"{"scenes": {"a": {}}}"#, "missing field `capture`")] {
            let said = error(wrong);
            assert!(said.contains(r#"scenes.json: expected {"scenes": {"NAME": {"capture": "FOLDER", "#), "{said}");
            assert!(said.contains(&format!("flags being optional, found {found}")), "{said}");
        }
        let both = error(r#"{"scenes": {"room": {"capture": "tandt/truck", "flags": ["--downscale=2"]}}}"#);
        let expected = "--protocol b: expected scenes.json without flags for the pictures of room, which it decides";
        assert_eq!(both, format!("{expected}, found `--downscale=2`"));
        // With a byte order mark, as editors on Windows write it.
        write(&["\u{feff}", r#"{"scenes": {"a": {"capture": "tandt/truck", "flags": ["--downscale=2"]}}}"#].concat());
        assert_eq!(super::all(&args(folder.path(), &["--protocol", "b"])).unwrap()[0].scene_flags, ["--downscale=2"]);
    }

    #[test]
    fn pictures_of_mipnerf360_that_nothing_makes_smaller_are_told() {
        let folder = dataset(&["garden", "mine", "room"]);
        let said = |more: &[&str]| {
            let all = all(&args(folder.path(), more)).unwrap();
            of_full_size(&all.iter().collect::<Vec<_>>())
        };
        for more in [&[][..], &["--", "--masks"], &["--variant", "a=--max-side 99", "--variant", "b"]] {
            assert!(said(more).unwrap().starts_with("garden, room: trained at full size, "), "{more:?}");
        }
        assert_eq!(said(&["--scenes", "mine"]), None);
        for flag in ["--downscale=4", "--max-side=99", "--images=images_4"] {
            assert_eq!(said(&["--", flag]), None);
        }
        assert_eq!(said(&["--protocol", "a"]), None);
    }

    #[test]
    fn what_cannot_be_done_is_said_before_anything_is() {
        let folder = dataset(&["garden"]);
        let error = |more: &[&str]| {
            let args = args(folder.path(), more);
            let all = all(&args)
                .and_then(|all| chosen(&all, &args).map(|jobs| jobs.into_iter().cloned().collect::<Vec<_>>()));
            let result = all.and_then(|jobs| jobs.iter().try_for_each(Job::check));
            format!("{:#}", result.unwrap_err())
        };
        assert!(error(&["--scenes", "house"]).ends_with("expected a scene `house`, found garden"));
        assert!(error(&["--only", "x/garden-0"]).starts_with("--only x/garden-0: expected one of the 1 jobs"));
        assert!(error(&["--variant", "a", "--variant", "a=--no-mesh"]).contains("given twice"));
        assert_eq!(error(&["--variant", "a", "--variant", "A"]), "--variant A: given before in another case");
        assert_eq!(error(&["--seeds", "1,0,1"]), "--seeds: 1 given twice");
        let list = ["centaur", "bench", "data", "-o", "out", "--list", "--json"];
        assert!(Cli::try_parse_from(list).is_err(), "commands are no JSON");
        assert_eq!(
            error(&["--", "--help"]),
            "flags of default/garden-0: expected those of a training, found one that prints help"
        );
        let flag = error(&["--", "--no-messh"]);
        assert!(flag.starts_with("flags of default/garden-0: ") && flag.contains("--no-messh"), "{flag}");
        let pictures = "expected no flag for the pictures, which it decides, found";
        for (more, found) in [
            (&["--protocol", "a", "--", "--max-side=300"][..], format!("--protocol a: {pictures} `--max-side=300`")),
            (&["--protocol", "b", "--variant", "x=--lambda 0 --masks"], format!("--protocol b: {pictures} `--masks`")),
        ] {
            assert_eq!(error(more), found);
        }
        all(&args(folder.path(), &["--", "--max-side=300"])).unwrap();
        let empty = tempfile::tempdir().unwrap();
        let refused = |folder: &Path| scenes(folder, false).unwrap_err().to_string();
        assert!(refused(empty.path()).contains("expected a folder of captures"));
        // A folder in it has a model, too, and would be taken for a scene.
        let inner = refused(&folder.path().join("garden"));
        assert!(inner.contains("garden: is itself a capture: give the folder that contains it"), "{inner}");
        assert_eq!(variant("Aux=--no-mesh").unwrap_err(), "expected another name: on Windows, Aux is a device");
        assert!(variant("=--no-mesh").is_err() && variant("a/b").is_err() && variant("a").unwrap().flags.is_empty());
        assert!(shard("4/4").is_err() && shard("x").is_err() && shard("3/4").is_ok());
        assert_eq!(size_of("room", Protocol::A), ["--images", "images_2"]);
    }
}
