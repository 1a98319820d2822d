//! Printing of the results of `stages`.

use centaur::render::gpu::{Gpu, measure::Ceilings};

use super::{Curve, Memory, Run};

/// Stages and the shader files that belong to them. Kernels outside all stages are shown under their own heading.
const GROUPS: [(&str, &[&str]); 10] = [
    ("project", &["project_splats"]),
    (
        "sort and lists",
        &[
            "scan",
            "dispatch_sizes",
            "compact_visible",
            "radix_sort",
            "radix_sort_serial",
            "order_splats",
            "gather_counts",
            "emit_pairs",
            "tile_ranges",
        ],
    ),
    ("mesh forward", &["setup_triangles", "bin_triangles", "raster_layers", "shade_layers"]),
    (FORWARD, &["blend_forward"]),
    ("loss", &["loss", "loss_serial"]),
    (BACKWARD, &["blend_backward"]),
    ("splat backward", &["sum_pairs", "splat_backward"]),
    ("mesh backward", &["gradient_peak", "texel_backward", "texel_backward_serial"]),
    ("Adam, splats", &["adam_splats"]),
    ("Adam, texels", &["adam_texels", "build_mips"]),
];
const FORWARD: &str = "blend forward";
const BACKWARD: &str = "blend backward";

impl Run {
    /// Seconds spent in the kernels whose shader file `wanted` accepts.
    fn seconds(&self, wanted: impl Fn(&str) -> bool) -> f64 {
        let file = |kernel: &str| kernel.split(':').next().is_some_and(&wanted);
        self.times.stages.iter().filter(|s| file(&s.kernel)).map(|s| s.seconds).fold(0.0, |sum, s| sum + s)
    }

    fn group(&self, name: &str) -> f64 {
        let files = GROUPS.iter().find(|g| g.0 == name).map_or(&[][..], |g| g.1);
        self.seconds(|f| files.contains(&f))
    }
}

/// Prints the adapter and its ceilings.
pub(crate) fn print_adapter(gpu: &Gpu, ceilings: Option<&Ceilings>) {
    println!("{} (subgroups: {})", gpu.adapter(), gpu.profile().subgroups);
    let Some(c) = ceilings else {
        println!("no timestamps: neither ceilings nor stages can be measured, only whole steps");
        return;
    };
    println!("  splat·pixel evaluations  {:9.0} M/s", c.evaluations / 1e6);
    println!("  atomic additions         {:9.0} M/s", c.atomic_adds / 1e6);
    println!("  copy, read + written     {:9.1} GB/s", c.copy_bytes / 1e9);
    println!("  dispatch of one thread   {:9.1} µs", c.dispatch_seconds * 1e6);
}

/// Prints a table with one column per run.
pub(crate) fn print_stages(runs: &[Run], ceilings: Option<&Ceilings>) {
    let row = |label: &str, cell: &dyn Fn(usize, &Run) -> String| {
        let cells: String = runs.iter().enumerate().map(|(i, r)| format!("{:>16}", cell(i, r))).collect();
        println!("{label:<44}{cells}");
    };
    let ms = |seconds: f64| format!("{:.2}", seconds * 1e3);
    let percent = |fraction: f64| format!("{:.1} %", 100.0 * fraction);
    let millions = |count: usize| format!("{:.2} M", count as f64 / 1e6);
    row("splats", &|_, r| r.splats.to_string());
    row("image", &|_, r| format!("{}×{}", r.width, r.height));
    row("mesh", &|_, r| if r.mesh { "on" } else { "off" }.into());
    row("visible splats", &|_, r| r.times.visible.to_string());
    row("pairs per visible splat", &|_, r| format!("{:.2}", r.times.pairs as f64 / r.times.visible.max(1) as f64));
    row("evaluations, at most (256 per pair)", &|_, r| millions(256 * r.times.pairs));
    row("evaluations, up to the last pair used", &|_, r| millions(r.times.evaluations));
    for (name, _) in GROUPS {
        row(&format!("{name} (ms)"), &|_, r| ms(r.group(name)));
    }
    let known = |file: &str| GROUPS.iter().any(|g| g.1.contains(&file));
    let other = |r: &Run| r.seconds(|f| !known(f));
    if runs.iter().any(|r| other(r) > 0.0) {
        row("other kernels (ms)", &|_, r| ms(other(r)));
    }
    row("all stages (ms)", &|_, r| ms(r.seconds(|_| true)));
    row("step by the host's clock (ms)", &|_, r| ms(r.times.step_seconds));
    row("forward frame (frames/s)", &|_, r| format!("{:.1}", 1.0 / r.times.frame_seconds.max(1e-9)));
    if let Some(c) = ceilings {
        let of_ceiling = |r: &Run, evaluations: usize, name: &str| {
            percent(evaluations as f64 / r.group(name).max(1e-9) / c.evaluations)
        };
        // The forward pass evaluates more fragments than it uses and fewer than all pairs have; the requirement applies
        // to the lower of the two fractions.
        row("blend forward, of the ceiling (≥ 50 %)", &|_, r| of_ceiling(r, r.times.evaluations, FORWARD));
        row("  if it skipped nothing", &|_, r| of_ceiling(r, 256 * r.times.pairs, FORWARD));
        row("blend backward × 3, of the ceiling (≥ 35 %)", &|_, r| of_ceiling(r, 3 * r.times.evaluations, BACKWARD));
        row("not blending, of the step (≤ 35 %)", &|_, r| {
            percent(1.0 - (r.group(FORWARD) + r.group(BACKWARD)) / r.times.step_seconds.max(1e-9))
        });
    }
    if runs.iter().any(|r| r.mesh) {
        row("mesh on / off (≤ 1.30)", &|i, r| match i.checked_sub(1).map(|j| &runs[j]) {
            Some(off) if r.mesh => format!("{:.2}", r.times.step_seconds / off.times.step_seconds),
            _ => String::new(),
        });
    }
}

/// Prints step times as a function of one quantity.
pub(crate) fn print_curve(curve: &Curve) {
    let (over, (fixed, slope)) = (curve.over, curve.line);
    println!("\nstep time ∝ {over}^{:.2}", curve.exponent);
    println!(
        "  or {:.2} ms + {:.1} ns × {over}, off by {:.1} % at most",
        fixed * 1e3,
        slope * 1e9,
        100.0 * curve.off_line
    );
    for (x, seconds) in &curve.points {
        println!("  {x:9.0} {over}  {:9.2} ms  {:7.1} ns each", seconds * 1e3, seconds / x * 1e9);
    }
}

/// Prints the GPU memory that training takes.
pub(crate) fn print_memory(memory: &Memory) {
    println!("\nGPU memory while training, by difference");
    println!("  per splat of degree 3  {:7.0} bytes", memory.per_splat);
    println!("  per float of the maps  {:7.2} bytes", memory.per_map_float);
    println!("  per pixel, one layer   {:7.1} bytes", memory.per_pixel);
    println!("  measured / accounted   {:7.3}", memory.agreement);
    let gigabytes = |bytes: u64| format!("{:.2} GB", bytes as f64 / 1e9);
    println!("\n200,000 triangles, 2048² atlas, 1920×1080");
    if let Some(refused) = &memory.large.refused {
        println!("  1000000 splats, not trained: {refused}");
    }
    if let Some(t) = &memory.large.trained {
        println!("  {} splats, trained  {}, by the account {}", t.splats, gigabytes(t.bytes), gigabytes(t.accounted));
    }
    println!("  1000000 splats, by the account  {} (≤ 8 GB)", gigabytes(memory.large.accounted));
}
