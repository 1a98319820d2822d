//! Benchmarks: what an adapter can do at best, and what each stage of a frame takes.

use super::device::{Frame, Gpu, GpuError, Kernel, Timer};

/// Upper bounds of an adapter.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct Ceilings {
    /// Splat·pixel evaluations per second (conic, exp, blend) without memory traffic.
    pub evaluations: f64,
    /// f32 atomic additions per second, spread over 65,536 slots.
    pub atomic_adds: f64,
    /// Bytes per second, read plus written.
    pub copy_bytes: f64,
    /// Seconds that a dispatch of one thread takes.
    pub dispatch_seconds: f64,
}

/// Measures [`Ceilings`], best of five runs each; None where the adapter has no timestamps.
///
/// # Errors
/// If the driver fails.
pub fn ceilings(gpu: &Gpu) -> Result<Option<Ceilings>, GpuError> {
    const WORDS: usize = 1 << 23;
    let Some(mut timer) = Timer::new(gpu) else { return Ok(None) };
    let source = gpu.storage("ceilings", WORDS)?;
    let sums = gpu.storage("ceilings", 1 << 16)?;
    let destination = gpu.storage("ceilings", WORDS)?;
    let loops: u32 = if gpu.profile().is_cpu { 256 } else { 4096 };
    let groups = if gpu.profile().is_cpu { 256 } else { 4096 };
    let defines = gpu.defines().with("LOOPS", loops).with("COPY", 0);
    let mut best = |entry: &str, groups: usize| -> Result<f64, GpuError> {
        let copies = entry == "copy";
        let defines = defines.clone().with("COPY", u32::from(copies));
        let kernel = Kernel::new(gpu, "ceilings.wgsl", entry, &defines);
        let bindings = if copies {
            kernel.bind(gpu, &[&source, &sums, &destination])
        } else {
            kernel.bind(gpu, &[&source, &sums])
        };
        let mut best = f64::INFINITY;
        for _ in 0..6 {
            let mut frame = Frame::timed(gpu, &mut timer);
            frame.dispatch(&kernel, &bindings, groups);
            frame.submit();
            best = best.min(timer.seconds(gpu)?[0].1.max(1e-9));
        }
        Ok(best)
    };
    let threads = (groups * 256) as f64;
    Ok(Some(Ceilings {
        evaluations: threads * f64::from(loops) / best("evaluate", groups)?,
        atomic_adds: threads * f64::from(loops) / best("atomics", groups)?,
        copy_bytes: (8 * WORDS) as f64 / best("copy", WORDS / 256)?,
        dispatch_seconds: best("nothing", 1)?,
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[ignore = "a measurement"]
    fn print_ceilings() {
        eprintln!("{:?}", ceilings(&Gpu::open(None).unwrap()).unwrap());
    }
}
