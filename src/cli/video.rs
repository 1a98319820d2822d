//! Film made of images, by ffmpeg.

use std::fs::File;
use std::io::{self, Read as _, Seek as _, Write as _};
use std::path::{Component, Path, PathBuf};
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context as _, Result, anyhow, bail, ensure};
use centaur::atomic::{self, Staging, folder_of};
use centaur::format::pixel_aspect;
use centaur::scene::Camera;

/// Deviation from 1 of a pixel's aspect ratio up to which it counts as square: focal lengths of captures differ by a
/// thousandth.
const SQUARE: f32 = 0.005;

/// Pixel aspect ratio (width over height) of a camera's image.
pub(super) fn aspect(camera: &Camera) -> f32 {
    pixel_aspect(camera.intrinsics())
}

/// Rejects what cannot become a film, before it is rendered. The film may be in the folder of `pictures`, which may not
/// exist yet.
pub(super) fn check(path: &Path, pictures: &Path, cameras: &[(String, Camera)]) -> Result<()> {
    let plain = |path: &Path| path.components().filter(|part| *part != Component::CurDir).collect::<PathBuf>();
    let is_among = path.parent().is_some_and(|folder| plain(folder) == plain(pictures));
    if pictures.exists() || !is_among {
        super::output::check_file(path)?;
    }
    let size = |camera: &Camera| (camera.intrinsics().width, camera.intrinsics().height);
    let mut sizes = cameras.iter().map(|(name, camera)| (name, size(camera)));
    if let Some((_, first)) = sizes.next()
        && let Some((name, other)) = sizes.find(|(_, size)| *size != first)
    {
        bail!(
            "--video: expected pictures of one size, found {}×{} and {}×{} of {name}; --max-side or other cameras may help",
            first.0,
            first.1,
            other.0,
            other.1
        );
    }
    let mut aspects = cameras.iter().map(|(name, camera)| (name, aspect(camera)));
    if let Some((_, first)) = aspects.next()
        && let Some((name, other)) = aspects.find(|(_, other)| (other / first - 1.0).abs() > SQUARE)
    {
        bail!(
            "--video: expected pixels of one shape, found {first} times as wide as high and {other} of {name}; other cameras may help"
        );
    }
    let asked = Command::new("ffmpeg")
        .arg("-version")
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status();
    if asked.is_err_and(|e| e.kind() == io::ErrorKind::NotFound) {
        bail!(
            "{}: cannot be made: there is no ffmpeg on PATH; install it (apt-get install ffmpeg, brew install ffmpeg, winget \
             install ffmpeg) or leave --video out, which leaves the pictures",
            path.display()
        );
    }
    Ok(())
}

/// Whether a film was made.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Film {
    Made,
    /// Stopped before its end: nothing of it is left.
    Stopped,
}

/// Encodes PNG files, in order, as an H.264 film with so many frames per second and pixels of this aspect ratio.
/// Written atomically, unless `stop` is set before it is complete.
pub(super) fn write(path: &Path, pictures: &[PathBuf], (fps, aspect): (f64, f32), stop: &AtomicBool) -> Result<Film> {
    if stop.load(Ordering::Relaxed) {
        return Ok(Film::Stopped);
    }
    let named = || format!("{}: cannot write", path.display());
    let place = atomic::place_of(path).with_context(named)?;
    let staging = Staging::within(folder_of(&place)).with_context(named)?;
    let film = staging.path().join("film.mp4");
    let mut messages = tempfile::tempfile_in(staging.path()).with_context(named)?;
    let spawned = Command::new("ffmpeg")
        .args(arguments(fps, aspect))
        .arg(&film)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(messages.try_clone().with_context(named)?)
        .spawn();
    let mut child = spawned.context("ffmpeg")?;
    let stdin = child.stdin.take().context("ffmpeg has no input")?;
    // By a thread of its own, which waits wherever ffmpeg is slower, and ends with it.
    let (ended, fed) = std::thread::scope(|scope| {
        let feeder = scope.spawn(|| feed(pictures, stdin, stop));
        let ended = end_of(&mut child, stop);
        (ended, feeder.join())
    });
    // Ctrl-C in a terminal ends ffmpeg, too.
    let Some(status) = ended.context("ffmpeg")?.filter(|_| !stop.load(Ordering::Relaxed)) else {
        return Ok(Film::Stopped);
    };
    let fed = fed.map_err(|_| anyhow!("{}: not made: its pictures cannot be read", path.display()))?;
    if !status.success() {
        // ffmpeg stops reading when it fails, and states why.
        let mut said = String::new();
        messages.rewind()?;
        messages.take(1 << 16).read_to_string(&mut said).ok();
        let reason = said.lines().map(str::trim).find(|line| !line.is_empty()).unwrap_or("it does not say why");
        bail!("{}: not made: ffmpeg: {reason}", path.display());
    }
    fed.with_context(|| format!("{}: not made: ffmpeg stopped reading", path.display()))?;
    let length = film.metadata().map_or(0, |made| made.len());
    ensure!(length > 0, "{}: not made: ffmpeg wrote nothing", path.display());
    atomic::rename(&film, &place).with_context(named)?;
    Ok(Film::Made)
}

/// Writes files to a pipe, and closes it.
fn feed(pictures: &[PathBuf], mut pipe: ChildStdin, stop: &AtomicBool) -> io::Result<()> {
    for picture in pictures {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        io::copy(&mut File::open(picture)?, &mut pipe)?;
    }
    pipe.flush()
}

/// How often a process is asked whether it has ended.
const POLL: Duration = Duration::from_millis(20);

/// Waits for the end of a process, or ends it once `stop` is set: `None`.
fn end_of(child: &mut Child, stop: &AtomicBool) -> io::Result<Option<ExitStatus>> {
    while !stop.load(Ordering::Relaxed) {
        if let Some(status) = child.try_wait()? {
            return Ok(Some(status));
        }
        std::thread::sleep(POLL);
    }
    child.kill()?;
    child.wait()?;
    Ok(None)
}

/// Arguments of ffmpeg except the output. 4:2:0 requires even sides, obtained by a black row or column; colours are
/// those of HD video.
fn arguments(fps: f64, aspect: f32) -> Vec<String> {
    let aspect = if (aspect - 1.0).abs() > SQUARE { aspect } else { 1.0 };
    let even = "pad=ceil(iw/2)*2:ceil(ih/2)*2,scale=out_color_matrix=bt709:out_range=tv,format=yuv420p";
    let filter = format!("{even},setsar={aspect}");
    let fps = fps.to_string();
    let arguments = [
        ["-loglevel", "error"],
        ["-f", "png_pipe"],
        ["-framerate", &fps],
        ["-i", "-"],
        ["-vf", &filter],
        ["-c:v", "libx264"],
        ["-crf", "18"],
        ["-pix_fmt", "yuv420p"],
        ["-colorspace", "bt709"],
        ["-color_primaries", "bt709"],
        ["-color_trc", "bt709"],
        ["-movflags", "+faststart"],
        ["-f", "mp4"],
    ];
    arguments.iter().flatten().map(|argument| (*argument).to_owned()).chain(["-y".to_owned()]).collect()
}
