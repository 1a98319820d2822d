use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use image::Rgb32FImage;
use ndarray::{Array2, ArrayView2, ArrayViewMut2, linalg::general_mat_mul};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{check_least, check_same_size};
use crate::scene::SceneError;

/// Mean and standard deviation, for images from −1 to 1, of the colours on which the networks were trained.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Added to the norm of a pixel's features before division by it.
const EPSILON: f32 = 1e-10;
/// Most bytes of a safetensors header; VGG's has 4000.
const HEADER: u64 = 1 << 20;
/// Bytes of the patch matrix that a thread multiplies at a time.
const PATCHES: usize = 4 << 20;

/// Network whose features are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum LpipsNet {
    /// VGG-16: used by 3DGS, HERA, Mip-Splatting.
    Vgg,
    /// `AlexNet`: used by gsplat, and by `NerfBaselines` on Tanks and Temples.
    Alex,
}

impl LpipsNet {
    /// Name of the network in tables.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Vgg => "VGG",
            Self::Alex => "Alex",
        }
    }

    /// Smallest side of an image for which every feature map has at least one pixel.
    fn least(self) -> u32 {
        match self {
            Self::Vgg => 16,
            Self::Alex => 31,
        }
    }
}

/// Range of the colours passed to the network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LpipsRange {
    /// From −1 to 1, the range for which the network was made.
    Normalized,
    /// From 0 to 1, as INRIA's script does and hence most published splatting tables. Gives lower distances.
    Unnormalized,
}

/// LPIPS distances of a pair of images under both conventions.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct LpipsScore {
    /// Network whose features were compared.
    pub net: LpipsNet,
    /// Distance with colours from −1 to 1.
    pub normalized: f64,
    /// Distance with colours from 0 to 1.
    pub unnormalized: f64,
}

/// Errors of reading network weights.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LpipsError {
    /// The file cannot be read.
    #[error("{}: cannot read: {source}", file.display())]
    Read {
        /// Path of the file.
        file: PathBuf,
        /// Cause.
        source: std::io::Error,
    },
    /// A tensor or the header is missing or not as expected.
    #[error("{}: {fault}", file.display())]
    Content {
        /// Path of the file.
        file: PathBuf,
        /// What is wrong with a tensor, or with the `header`.
        fault: SceneError,
    },
}

/// Learned perceptual image distance LPIPS v0.1 (Zhang et al. 2018): a network's features at five depths are normalised
/// per pixel; their squared differences are weighted per channel and averaged over the image.
///
/// With VGG, comparing two images takes 768 bytes per pixel (three maps of 64 floats), besides 59 MB of weights.
///
/// The weights are not distributed with this crate; `datasets-scripts/lpips_weights.py` downloads them and writes the
/// file.
pub struct Lpips {
    net: LpipsNet,
    steps: Vec<Step>,
    /// Channel weights of each tap.
    linear: Vec<Vec<f32>>,
}

enum Step {
    /// Convolution whose negative outputs become 0 (`ReLU`).
    Convolve(Convolution),
    /// Max pooling over `size`×`size` pixels with stride 2.
    Pool { size: usize },
    /// Depth at which features are compared.
    Tap,
}

struct Convolution {
    kernel: usize,
    stride: usize,
    padding: usize,
    /// `[kernel·kernel·channels, outputs]`, row-major in (row, column, channel).
    weights: Array2<f32>,
    bias: Vec<f32>,
}

/// Feature map `[height, width, channels]`.
struct Features {
    height: usize,
    width: usize,
    channels: usize,
    values: Vec<f32>,
}

/// Layer: a convolution (kernel, stride, padding, outputs), a max pool (size), or a tap.
enum Layer {
    Conv(String, [usize; 4]),
    Pool(usize),
    Tap,
}

fn layers(net: LpipsNet) -> Vec<Layer> {
    let mut layers = vec![];
    match net {
        LpipsNet::Vgg => {
            for (block, (count, outputs)) in [(2, 64), (2, 128), (3, 256), (3, 512), (3, 512)].into_iter().enumerate() {
                if block > 0 {
                    layers.push(Layer::Pool(2));
                }
                layers.extend((1..=count).map(|i| Layer::Conv(format!("conv{}_{i}", block + 1), [3, 1, 1, outputs])));
                layers.push(Layer::Tap);
            }
        }
        LpipsNet::Alex => {
            let shapes = [[11, 4, 2, 64], [5, 1, 2, 192], [3, 1, 1, 384], [3, 1, 1, 256], [3, 1, 1, 256]];
            for (i, shape) in shapes.into_iter().enumerate() {
                if i == 1 || i == 2 {
                    layers.push(Layer::Pool(3));
                }
                layers.push(Layer::Conv(format!("conv{}", i + 1), shape));
                layers.push(Layer::Tap);
            }
        }
    }
    layers
}

impl Lpips {
    /// Reads weights from a safetensors file of f32 tensors `conv1_1.weight` `[64, 3, 3, 3]`, `conv1_1.bias` `[64]` …
    /// `conv5_3` of VGG-16, or `conv1` … `conv5` of `AlexNet`, and `lin0.weight` … `lin4.weight`, one weight per
    /// channel of each depth. Other content of the file is not read, however long.
    ///
    /// # Errors
    /// If the file cannot be read, or a tensor is missing, has another shape or type, or holds a non-finite value.
    pub fn open(file: &Path) -> Result<Self, LpipsError> {
        let content = File::open(file).map_err(|source| LpipsError::Read { file: file.to_owned(), source })?;
        Self::read(content).map_err(|fault| LpipsError::Content { file: file.to_owned(), fault })
    }

    fn read(source: impl Read + Seek) -> Result<Self, SceneError> {
        let mut weights = Weights::new(source)?;
        let net = if weights.header.contains_key("conv1_1.weight") { LpipsNet::Vgg } else { LpipsNet::Alex };
        let (mut steps, mut linear, mut channels) = (vec![], vec![], 3);
        for layer in layers(net) {
            steps.push(match layer {
                Layer::Conv(name, [kernel, stride, padding, outputs]) => {
                    let stored = weights.tensor(&format!("{name}.weight"), &[outputs, channels, kernel, kernel])?;
                    let bias = weights.tensor(&format!("{name}.bias"), &[outputs])?;
                    let area = kernel * kernel;
                    let weights = Array2::from_shape_fn((area * channels, outputs), |(row, output)| {
                        stored[(output * channels + row % channels) * area + row / channels]
                    });
                    channels = outputs;
                    Step::Convolve(Convolution { kernel, stride, padding, weights, bias })
                }
                Layer::Pool(size) => Step::Pool { size },
                Layer::Tap => {
                    linear.push(weights.tensor(&format!("lin{}.weight", linear.len()), &[channels])?);
                    Step::Tap
                }
            });
        }
        Ok(Self { net, steps, linear })
    }

    /// Network whose features are compared.
    #[must_use]
    pub fn net(&self) -> LpipsNet {
        self.net
    }

    /// Checks that images of this width and height are large enough for the network.
    ///
    /// # Errors
    /// If a side is shorter than 16 (VGG) or 31 (Alex) pixels.
    pub fn check_size(&self, size: (u32, u32)) -> Result<(), SceneError> {
        check_least("LPIPS", self.net.least(), size)
    }

    /// LPIPS distance under both conventions.
    ///
    /// # Errors
    /// If the sizes differ or a side is shorter than 16 (VGG) or 31 (Alex) pixels.
    pub fn score(&self, truth: &Rgb32FImage, render: &Rgb32FImage) -> Result<LpipsScore, SceneError> {
        let total = |range| self.distances(truth, render, range).map(|d| d.iter().sum());
        Ok(LpipsScore {
            net: self.net,
            normalized: total(LpipsRange::Normalized)?,
            unnormalized: total(LpipsRange::Unnormalized)?,
        })
    }

    /// Contributions of the five depths to the distance.
    ///
    /// # Errors
    /// Same as [`Self::score`].
    pub fn distances(
        &self,
        truth: &Rgb32FImage,
        render: &Rgb32FImage,
        range: LpipsRange,
    ) -> Result<Vec<f64>, SceneError> {
        check_same_size(truth, render)?;
        self.check_size(truth.dimensions())?;
        let (mut a, mut b) = (Features::of(truth, range), Features::of(render, range));
        let (mut linear, mut distances) = (self.linear.iter(), vec![]);
        for step in &self.steps {
            match step {
                Step::Convolve(convolution) => {
                    // One image after the other, so that the first one's temporaries are freed before the second one's
                    // are allocated.
                    a = convolution.run(&a);
                    b = convolution.run(&b);
                }
                Step::Pool { size } => (a, b) = (a.pooled(*size), b.pooled(*size)),
                Step::Tap => distances.extend(linear.next().map(|weights| distance(&a, &b, weights))),
            }
        }
        Ok(distances)
    }
}

/// Safetensors file that is read tensor by tensor, on request.
struct Weights<R> {
    source: R,
    /// Header entry of each tensor, by name.
    header: BTreeMap<String, Value>,
    /// Offset of the tensor data in the file, in bytes.
    start: u64,
}

/// What a file is that begins like none of weights.
fn content(start: &[u8]) -> &'static str {
    match start {
        [] => "an empty file",
        [b'g', b'l', b'T', b'F', ..] => "glTF",
        [b'p', b'l', b'y', ..] => "PLY",
        [b'P', b'K', 3, 4, ..] | [0x80, 2, ..] => "a zip or a pickle, as PyTorch writes .pth",
        _ => "other content",
    }
}

#[derive(Deserialize)]
struct Stored {
    dtype: String,
    shape: Vec<usize>,
    data_offsets: [u64; 2],
}

impl<R: Read + Seek> Weights<R> {
    fn new(mut source: R) -> Result<Self, SceneError> {
        let fault = |found: String| SceneError::new("header", "a safetensors file", found);
        let mut start = vec![];
        source.by_ref().take(8).read_to_end(&mut start).map_err(|e| fault(e.to_string()))?;
        let other = || fault(content(&start).to_owned());
        let length = start.first_chunk().map(|bytes| u64::from_le_bytes(*bytes));
        let length = length.filter(|length| *length <= HEADER).ok_or_else(other)?;
        let mut text = vec![];
        source.by_ref().take(length).read_to_end(&mut text).map_err(|e| fault(e.to_string()))?;
        // The first bytes of another file may happen to be such a length.
        let header = serde_json::from_slice(&text)
            .map_err(|e| if text.starts_with(b"{") { fault(e.to_string()) } else { other() })?;
        Ok(Self { source, header, start: 8 + length })
    }

    fn tensor(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, SceneError> {
        let fault = |expected: String, found: String| SceneError::new(name, expected, found);
        let expected = || format!("f32 {shape:?}");
        let stored = self.header.get(name).ok_or_else(|| fault(expected(), "no such tensor".to_owned()))?;
        let Stored { dtype, shape: found, data_offsets: [from, to] } = Stored::deserialize(stored)
            .map_err(|e| fault("dtype, shape and data_offsets".to_owned(), e.to_string()))?;
        // Some files store per-channel weights as 1×1 convolutions.
        let is_per_channel = shape.len() == 1 && found.iter().filter(|n| **n != 1).eq(shape);
        if dtype != "F32" || (found != shape && !is_per_channel) {
            return Err(fault(expected(), format!("{dtype} {found:?}")));
        }
        let mut values = vec![0.0_f32; shape.iter().product()];
        let bytes: &mut [u8] = bytemuck::cast_slice_mut(&mut values);
        if to.checked_sub(from) != Some(bytes.len() as u64) {
            return Err(fault(format!("{} bytes", bytes.len()), format!("bytes {from} to {to}")));
        }
        let at = self.start.saturating_add(from);
        (self.source.seek(SeekFrom::Start(at)))
            .and_then(|_| self.source.read_exact(bytes))
            .map_err(|e| fault(format!("{} bytes from byte {at} on", bytes.len()), e.to_string()))?;
        // Safetensors data are little-endian.
        values.iter_mut().for_each(|v| *v = f32::from_bits(u32::from_le(v.to_bits())));
        match values.iter().position(|v| !v.is_finite()) {
            Some(i) => Err(fault("finite numbers".to_owned(), format!("{} at {i}", values[i]))),
            None => Ok(values),
        }
    }
}

impl Features {
    fn of(image: &Rgb32FImage, range: LpipsRange) -> Self {
        let (width, height) = (image.width() as usize, image.height() as usize);
        let color = |v: f32| if range == LpipsRange::Normalized { 2.0 * v - 1.0 } else { v };
        let values = image.pixels().flat_map(|p| [0, 1, 2].map(|c| (color(p.0[c]) - SHIFT[c]) / SCALE[c])).collect();
        Self { height, width, channels: 3, values }
    }

    fn pixel(&self, y: usize, x: usize) -> &[f32] {
        &self.values[(y * self.width + x) * self.channels..][..self.channels]
    }

    fn pooled(&self, size: usize) -> Self {
        let (height, width) = ((self.height - size) / 2 + 1, (self.width - size) / 2 + 1);
        let mut values = vec![f32::NEG_INFINITY; height * width * self.channels];
        values.par_chunks_mut(width * self.channels).enumerate().for_each(|(y, row)| {
            for (x, most) in row.chunks_mut(self.channels).enumerate() {
                for (dy, dx) in (0..size * size).map(|i| (i / size, i % size)) {
                    let here = self.pixel(2 * y + dy, 2 * x + dx);
                    most.iter_mut().zip(here).for_each(|(most, &v)| *most = most.max(v));
                }
            }
        });
        Self { height, width, channels: self.channels, values }
    }
}

impl Convolution {
    /// Convolves by matrix product (im2col), a strip of rows at a time, and sets negative outputs to 0.
    fn run(&self, input: &Features) -> Features {
        let along = |side: usize| (side + 2 * self.padding - self.kernel) / self.stride + 1;
        let (height, width) = (along(input.height), along(input.width));
        let (patch, outputs) = self.weights.dim();
        let rows = (PATCHES / (4 * patch * width)).clamp(1, height);
        let mut values = vec![0.0; height * width * outputs];
        values.par_chunks_mut(rows * width * outputs).enumerate().for_each(|(strip, out)| {
            let count = out.len() / outputs;
            let mut patches = vec![0.0; count * patch];
            for (i, patch) in patches.chunks_mut(patch).enumerate() {
                self.gather(input, strip * rows + i / width, i % width, patch);
            }
            let patches = ArrayView2::from_shape((count, patch), &patches).expect("a row per pixel");
            let mut product = ArrayViewMut2::from_shape((count, outputs), &mut *out).expect("a row per pixel");
            general_mat_mul(1.0, &patches, &self.weights, 0.0, &mut product);
            for pixel in out.chunks_mut(outputs) {
                pixel.iter_mut().zip(&self.bias).for_each(|(v, bias)| *v = (*v + bias).max(0.0));
            }
        });
        Features { height, width, channels: outputs, values }
    }

    /// Copies the input under the kernel at output (y, x) into `patch`; zeros outside the input.
    fn gather(&self, input: &Features, y: usize, x: usize, patch: &mut [f32]) {
        for (tap, into) in patch.chunks_mut(input.channels).enumerate() {
            let row = (y * self.stride + tap / self.kernel).checked_sub(self.padding).filter(|&row| row < input.height);
            let column =
                (x * self.stride + tap % self.kernel).checked_sub(self.padding).filter(|&column| column < input.width);
            if let (Some(row), Some(column)) = (row, column) {
                into.copy_from_slice(input.pixel(row, column));
            }
        }
    }
}

/// Mean over pixels of the weighted squared difference of unit-length features.
fn distance(a: &Features, b: &Features, weights: &[f32]) -> f64 {
    let pairs = a.values.par_chunks_exact(a.channels).zip(b.values.par_chunks_exact(b.channels));
    let length = |v: &[f32]| v.iter().map(|x| x * x).sum::<f32>().sqrt() + EPSILON;
    let sum: f64 = pairs
        .map(|(a, b)| {
            let (la, lb) = (length(a), length(b));
            let terms = a.iter().zip(b).zip(weights);
            terms.map(|((a, b), w)| f64::from(w * (a / la - b / lb).powi(2))).sum::<f64>()
        })
        .collect::<Vec<f64>>() // in order, so that the sum is the same every time
        .into_iter()
        .sum();
    sum / (a.height * a.width) as f64
}

#[cfg(test)]
mod tests {
    use image::Rgb;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;
    use safetensors::Dtype;

    use super::*;

    fn tensor(name: &str, shape: &[usize], values: &[f32]) -> (String, (Vec<usize>, Vec<u8>)) {
        (name.to_owned(), (shape.to_vec(), values.iter().flat_map(|v| v.to_le_bytes()).collect()))
    }

    type Tensors = Vec<(String, (Vec<usize>, Vec<u8>))>;

    /// Random weights, scaled so that features stay near 1.
    fn random(net: LpipsNet, seed: u64) -> Tensors {
        let mut rng = Pcg32::seed_from_u64(seed);
        let (mut tensors, mut channels, mut taps) = (vec![], 3, 0);
        for layer in layers(net) {
            match layer {
                Layer::Conv(name, [kernel, _, _, outputs]) => {
                    let inputs = channels * kernel * kernel;
                    let size = (6.0 / inputs as f32).sqrt();
                    let weights: Vec<f32> = (0..outputs * inputs).map(|_| rng.random_range(-size..size)).collect();
                    tensors.push(tensor(&format!("{name}.weight"), &[outputs, channels, kernel, kernel], &weights));
                    let bias: Vec<f32> = (0..outputs).map(|_| rng.random_range(-0.1..0.1)).collect();
                    tensors.push(tensor(&format!("{name}.bias"), &[outputs], &bias));
                    channels = outputs;
                }
                Layer::Pool(_) => {}
                Layer::Tap => {
                    let weights: Vec<f32> = (0..channels).map(|_| rng.random_range(0.0..1.0)).collect();
                    tensors.push(tensor(&format!("lin{taps}.weight"), &[1, channels, 1, 1], &weights));
                    taps += 1;
                }
            }
        }
        tensors
    }

    fn bytes_of(tensors: &Tensors) -> Vec<u8> {
        let views = tensors.iter().map(|(name, (shape, bytes))| {
            (name.clone(), safetensors::tensor::TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap())
        });
        safetensors::serialize(views, None).unwrap()
    }

    fn opened(tensors: &Tensors) -> Result<Lpips, String> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes_of(tensors)).unwrap();
        let name = file.path().display().to_string();
        Lpips::open(file.path()).map_err(|e| e.to_string().replace(&name, "F"))
    }

    fn picture(seed: u64, side: u32) -> Rgb32FImage {
        let mut rng = Pcg32::seed_from_u64(seed);
        Rgb32FImage::from_fn(side, side + 3, |_, _| Rgb([0; 3].map(|_| rng.random_range(0.0..1.0))))
    }

    /// Comparison with the definition of a convolution, term by term.
    #[test]
    fn convolutions_are_what_they_are() {
        let mut rng = Pcg32::seed_from_u64(3);
        for (kernel, stride, padding) in [(3, 1, 1), (11, 4, 2), (5, 1, 2)] {
            let (h, w, channels, outputs) = (17, 13, 2, 4);
            let input = Features {
                height: h,
                width: w,
                channels,
                values: (0..h * w * channels).map(|_| rng.random()).collect(),
            };
            let weights = Array2::from_shape_fn((kernel * kernel * channels, outputs), |_| rng.random_range(-1.0..1.0));
            let bias: Vec<f32> = (0..outputs).map(|_| rng.random_range(-1.0..1.0)).collect();
            let convolution = Convolution { kernel, stride, padding, weights, bias };
            let found = convolution.run(&input);
            assert_eq!(found.height, (h + 2 * padding - kernel) / stride + 1);
            for (y, x, o) in (0..found.height * found.width * outputs)
                .map(|i| (i / outputs / found.width, i / outputs % found.width, i % outputs))
            {
                let mut sum = f64::from(convolution.bias[o]);
                for (ky, kx, c) in (0..kernel * kernel * channels)
                    .map(|i| (i / channels / kernel, i / channels % kernel, i % channels))
                {
                    let (row, column) =
                        ((y * stride + ky) as i64 - padding as i64, (x * stride + kx) as i64 - padding as i64);
                    if (0..h as i64).contains(&row) && (0..w as i64).contains(&column) {
                        let value = input.values[(row as usize * w + column as usize) * channels + c];
                        sum += f64::from(value * convolution.weights[((ky * kernel + kx) * channels + c, o)]);
                    }
                }
                assert!((f64::from(found.pixel(y, x)[o]) - sum.max(0.0)).abs() < 1e-4);
            }
        }
    }

    #[test]
    fn distances_grow_with_the_difference_and_are_symmetric() {
        for net in [LpipsNet::Vgg, LpipsNet::Alex] {
            let lpips = opened(&random(net, 1)).unwrap();
            assert_eq!(lpips.net(), net);
            let (a, b) = (picture(1, 37), picture(2, 37));
            let near = Rgb32FImage::from_fn(37, 40, |x, y| {
                Rgb([0, 1, 2].map(|c| 0.9 * a.get_pixel(x, y).0[c] + 0.1 * b.get_pixel(x, y).0[c]))
            });
            let [same, small, large, back] =
                [(&a, &a), (&a, &near), (&a, &b), (&b, &a)].map(|(x, y)| lpips.score(x, y).unwrap());
            assert_eq!((same.normalized, same.unnormalized), (0.0, 0.0));
            assert!(0.0 < small.normalized && 4.0 * small.normalized < large.normalized, "{small:?} {large:?}");
            assert!((large.normalized / back.normalized - 1.0).abs() < 1e-6);
            assert!(large.unnormalized != large.normalized && large.unnormalized > 0.0);
            let parts = lpips.distances(&a, &b, LpipsRange::Normalized).unwrap();
            assert_eq!(parts.len(), 5);
            assert!(parts.iter().all(|&d| d > 0.0) && (parts.iter().sum::<f64>() - large.normalized).abs() < 1e-12);
            let tiny = picture(1, net.least() - 1);
            assert!(
                lpips.score(&tiny, &tiny).unwrap_err().to_string().starts_with("LPIPS: expected images of at least")
            );
            let least = Rgb32FImage::from_pixel(net.least(), net.least(), Rgb([0.5; 3]));
            assert_eq!(lpips.score(&least, &least).unwrap().normalized, 0.0);
        }
    }

    #[test]
    fn weights_that_do_not_fit_are_named() {
        let mut tensors = random(LpipsNet::Alex, 1);
        tensors.retain(|(name, _)| name != "conv3.bias");
        assert_eq!(opened(&tensors).err().unwrap(), "F: conv3.bias: expected f32 [384], found no such tensor");
        let mut tensors = random(LpipsNet::Alex, 1);
        tensors[0].1.0 = vec![64, 3, 121];
        let error = opened(&tensors).err().unwrap();
        assert_eq!(error, "F: conv1.weight: expected f32 [64, 3, 11, 11], found F32 [64, 3, 121]");
        let mut tensors = random(LpipsNet::Alex, 1);
        tensors[1].1.1[4..8].copy_from_slice(&f32::NAN.to_le_bytes());
        assert_eq!(opened(&tensors).err().unwrap(), "F: conv1.bias: expected finite numbers, found NaN at 1");
        let file = tempfile::NamedTempFile::new().unwrap();
        for (bytes, found) in [
            (&b""[..], "an empty file"),
            (b"glTF\x02\0\0\0\x2a\0\0\0", "glTF"),
            (b"ply\nformat ascii 1.0", "PLY"),
            (b"PK\x03\x04\0\0\0\0", "a zip or a pickle, as PyTorch writes .pth"),
            (b"\x80\x02\x8a\nl\xfc\x9cF", "a zip or a pickle, as PyTorch writes .pth"),
            (b"short", "other content"),
            (b"no weights", "other content"),
            (b"\x02\0\0\0\0\0\0\0no weights", "other content"),
            (b"\x02\0\0\0\0\0\0\0{", "EOF while parsing an object at line 1 column 1"),
        ] {
            std::fs::write(file.path(), bytes).unwrap();
            let error = Lpips::open(file.path()).err().unwrap();
            let expected = format!(": header: expected a safetensors file, found {found}");
            assert!(error.to_string().ends_with(&expected), "{error}");
            assert!(std::error::Error::source(&error).is_none(), "a cause that the message quotes");
        }
    }

    /// A header can contain anything.
    #[test]
    fn damaged_weights_are_errors_not_panics() {
        let whole = bytes_of(&random(LpipsNet::Alex, 1));
        let header = 8 + u64::from_le_bytes(*whole.first_chunk().unwrap()) as usize;
        let mut rng = Pcg32::seed_from_u64(5);
        let (mut damaged, mut refused) = (whole.clone(), 0);
        for case in 0..300 {
            let at = if case % 4 == 0 { case % 8 } else { rng.random_range(8..header) };
            // Digits are replaced by other digits, which changes offsets and shapes.
            damaged[at] = if damaged[at].is_ascii_digit() { b'0' + rng.random_range(0..10) } else { rng.random() };
            let end = if case % 10 == 9 { rng.random_range(0..whole.len()) } else { whole.len() };
            refused += usize::from(Lpips::read(std::io::Cursor::new(&damaged[..end])).is_err());
            damaged[at] = whole[at];
        }
        assert!(refused > 200, "{refused}");
        let far = String::from_utf8(whole[8..header].to_vec()).unwrap().replacen(
            "\"data_offsets\":[",
            "\"data_offsets\":[1844674407370955",
            1,
        );
        let far = [&(far.len() as u64).to_le_bytes()[..], far.as_bytes()].concat();
        assert!(Lpips::read(std::io::Cursor::new(far)).is_err());
    }
}
