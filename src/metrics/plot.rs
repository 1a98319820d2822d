//! Small line plots as SVG text, for the report.

use std::fmt::Write as _;

use super::markup::escaped;

/// A line plot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plot {
    /// Caption, with the unit: `"held-out PSNR (dB)"`.
    pub title: String,
    /// Caption of the horizontal axis: `"iteration"`.
    pub x_label: String,
    /// Whether the vertical axis is logarithmic; points ≤ 0 are then left out.
    pub log_y: bool,
    /// (x, value); points that are not finite are left out.
    pub points: Vec<(f64, f64)>,
    /// Named parts of the horizontal axis: the x at which each begins, drawn as a vertical rule with the name to its
    /// right.
    pub parts: Vec<(f64, String)>,
}

const WIDTH: f64 = 420.0;
const HEIGHT: f64 = 240.0;
/// Margins: left, top, right, bottom.
const MARGIN: [f64; 4] = [52.0, 30.0, 14.0, 36.0];
/// Approximate mean width of a letter.
const LETTER: f64 = 5.5;
/// Points beyond this many are averaged: more cannot be distinguished at this width.
const MOST_POINTS: usize = 400;

/// Draws a plot as SVG. Colours come from the CSS variables `--ink`, `--rule` and `--accent` of the enclosing page,
/// with fallbacks for standalone SVG.
#[must_use]
pub fn svg(plot: &Plot) -> String {
    let scale = |v: f64| if plot.log_y { v.log10() } else { v };
    let points: Vec<(f64, f64)> = (plot.points.iter().map(|&(x, y)| (x, scale(y))))
        .filter(|(x, y)| x.is_finite() && y.is_finite() && x.abs() < 1e300 && y.abs() < 1e300)
        .collect();
    let points = averaged(&points);
    // The first part may begin before the first point.
    let begin = plot.parts.first().map(|(x, _)| *x).filter(|x| points.first().is_some_and(|p| *x < p.0));
    let (x0, x1) = range(points.iter().map(|p| p.0).chain(begin), 0.0);
    let (y0, y1) = range(points.iter().map(|p| p.1), 0.05);
    let px = |x: f64| MARGIN[0] + (x - x0) / (x1 - x0) * (WIDTH - MARGIN[0] - MARGIN[2]);
    let py = |y: f64| HEIGHT - MARGIN[3] - (y - y0) / (y1 - y0) * (HEIGHT - MARGIN[1] - MARGIN[3]);

    let title = escaped(&plot.title);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" \
         aria-label=\"{title}\" font-family=\"system-ui,sans-serif\" font-size=\"11\" \
         fill=\"var(--ink,#333)\">\n<text x=\"{}\" y=\"18\" font-size=\"13\">{title}</text>\n",
        MARGIN[0]
    );
    let mut text = |x: f64, y: f64, anchor: &str, label: &str| {
        let _ = writeln!(out, "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{label}</text>");
    };
    let (x_ticks, y_ticks) = (ticks(x0, x1), if plot.log_y { log_ticks(y0, y1) } else { ticks(y0, y1) });
    for &x in &x_ticks {
        text(px(x), HEIGHT - MARGIN[3] + 15.0, "middle", &short(x));
    }
    for &y in &y_ticks {
        text(MARGIN[0] - 6.0, py(y) + 4.0, "end", &short(if plot.log_y { 10_f64.powf(y) } else { y }));
    }
    text(WIDTH - MARGIN[2], HEIGHT - 5.0, "end", &escaped(&plot.x_label));
    let within = |x: f64| (x0..=x1).contains(&x);
    let (mut line, mut end) = (0.0, 0.0);
    for (x, name) in plot.parts.iter().filter(|(x, _)| within(*x)) {
        // Below the name before it, where that needs more room than its part has.
        line = if px(*x) < end { line + 1.0 } else { 0.0 };
        end = px(*x) + LETTER * name.chars().count() as f64;
        text(px(*x) + 4.0, MARGIN[1] + 8.0 + 12.0 * line, "start", &escaped(name));
    }
    let (left, right) = (MARGIN[0], WIDTH - MARGIN[2]);
    let rules: String = (y_ticks.iter()).fold(String::new(), |mut d, &y| {
        let _ = write!(d, "M{left:.1} {:.1}H{right:.1}", py(y));
        d
    });
    let rules = (plot.parts.iter().filter(|(x, _)| within(*x))).fold(rules, |mut d, (x, _)| {
        let _ = write!(d, "M{:.1} {:.1}V{:.1}", px(*x), MARGIN[1], HEIGHT - MARGIN[3]);
        d
    });
    let _ = writeln!(out, "<path d=\"{rules}\" stroke=\"var(--rule,#ddd)\" fill=\"none\"/>");
    match points.as_slice() {
        [] => {}
        [(x, y)] => {
            let _ = writeln!(
                out,
                "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"3\" fill=\"var(--accent,#06c)\"/>",
                px(*x),
                py(*y)
            );
        }
        _ => {
            let line: Vec<String> = points.iter().map(|&(x, y)| format!("{:.1},{:.1}", px(x), py(y))).collect();
            let _ = writeln!(
                out,
                "<polyline points=\"{}\" stroke=\"var(--accent,#06c)\" stroke-width=\"1.6\" fill=\"none\" \
                 stroke-linejoin=\"round\"/>",
                line.join(" ")
            );
        }
    }
    out.push_str("</svg>\n");
    out
}

/// Averages runs of neighbouring points to at most [`MOST_POINTS`].
fn averaged(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let run = points.len().div_ceil(MOST_POINTS).max(1);
    let mean = |c: &[(f64, f64)], f: fn(&(f64, f64)) -> f64| c.iter().map(f).sum::<f64>() / c.len() as f64;
    points.chunks(run).map(|c| (mean(c, |p| p.0), mean(c, |p| p.1))).collect()
}

/// Range of values, widened by the fraction `pad`, never empty.
fn range(values: impl Iterator<Item = f64>, pad: f64) -> (f64, f64) {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    if low > high {
        return (0.0, 1.0);
    }
    if high - low <= 1e-9 * high.abs() {
        let half = (0.1 * high.abs()).max(0.5);
        return (low - half, high + half);
    }
    let pad = pad * (high - low);
    (low - pad, high + pad)
}

/// About five tick positions in `low..=high`: multiples of 1, 2 or 5 times a power of ten.
fn ticks(low: f64, high: f64) -> Vec<f64> {
    let raw = (high - low) / 5.0;
    let decade = 10_f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * decade).into_iter().find(|s| *s >= raw).unwrap_or(raw);
    let first = (low / step).ceil();
    (0..12).map(|k| (first + f64::from(k)) * step).take_while(|t| *t <= high).collect()
}

/// Tick positions of a logarithmic axis: logarithms of 1, 2 and 5 times powers of ten in `low..=high` (themselves
/// logarithms), thinned over many decades. If there are fewer than two, the logarithms of a linear axis's ticks.
fn log_ticks(low: f64, high: f64) -> Vec<f64> {
    if high - low > 3.0 {
        return ticks(low, high).into_iter().filter(|t| t.fract() == 0.0).collect();
    }
    let marks = |d: i32| [1.0_f64, 2.0, 5.0].map(|m| f64::from(d) + m.log10());
    let decades = low.floor() as i32..=high.ceil() as i32;
    let found: Vec<f64> = decades.flat_map(marks).filter(|t| (low..=high).contains(t)).collect();
    if found.len() < 2 {
        ticks(10_f64.powf(low), 10_f64.powf(high)).into_iter().map(f64::log10).collect()
    } else {
        found
    }
}

/// Formats a number for an axis with at most four significant digits: `12000` as `12k`, `0.05` as `0.05`.
fn short(v: f64) -> String {
    let (v, suffix) = match v.abs() {
        a if a >= 1e6 => (v / 1e6, "M"),
        a if a >= 1e4 => (v / 1e3, "k"),
        _ => (v, ""),
    };
    let decimals = if v.abs() >= 100.0 || v == 0.0 { 0 } else { (3 - v.abs().log10().ceil() as i32).clamp(0, 9) };
    let text = format!("{v:.*}", decimals as usize);
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    format!("{text}{suffix}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_are_short_and_round() {
        let cases = [(0.0, "0"), (12_000.0, "12k"), (1.5e6, "1.5M"), (0.05, "0.05"), (500.0, "500"), (2500.0, "2500")];
        for (v, text) in cases {
            assert_eq!(short(v), text);
        }
        assert_eq!(ticks(0.0, 30_000.0), [0.0, 10_000.0, 20_000.0, 30_000.0]);
        assert_eq!(log_ticks(-2.0, -1.0).len(), 4);
        let labels: Vec<String> =
            log_ticks(0.055_f64.log10(), 0.095_f64.log10()).iter().map(|t| short(10_f64.powf(*t))).collect();
        assert_eq!(labels, ["0.06", "0.07", "0.08", "0.09"]);
    }

    #[test]
    fn names_of_parts_are_not_printed_over_each_other() {
        let places = |points: &[f64]| -> Vec<(f64, f64)> {
            let part = |x: f64, name: &str| (x, name.to_owned());
            let parts = vec![part(0.0, "surface"), part(30.0, "warm-up"), part(50.0, "joint")];
            let points = points.iter().map(|&x| (x, x)).collect();
            let text = svg(&Plot { parts, points, ..Plot::default() });
            let number = |line: &str, name: &str| -> f64 {
                line.split_once(&format!("{name}=\"")).unwrap().1.split('"').next().unwrap().parse().unwrap()
            };
            let named = text.lines().filter(|line| line.contains("\"start\""));
            named.map(|line| (number(line, " x"), number(line, " y"))).collect()
        };
        // As where held-out views are measured at the end of each phase only.
        for points in [&[30.0, 50.0, 110.0][..], &[10.0, 20.0, 30.0, 110.0]] {
            let [first, second, third] = places(points)[..] else { panic!("{points:?}: {:?}", places(points)) };
            assert!(first.0 < second.0 && second.0 < third.0 && first.1 == second.1, "{points:?}");
        }
        // Parts too narrow for their names.
        let narrow = places(&[30.0, 3000.0]);
        assert!(narrow[0].1 < narrow[1].1 && narrow[1].1 < narrow[2].1, "{narrow:?}");
    }

    #[test]
    fn every_input_draws_something_finite() {
        let many = (0..100_000).map(|i| (f64::from(i), 1.0 / f64::from(i + 1))).collect();
        for (log_y, points) in [
            (false, vec![]),
            (true, vec![(0.0, 0.0), (1.0, -3.0)]),
            (false, vec![(5.0, 5.0)]),
            (false, vec![(0.0, 1.0), (1.0, f64::NAN), (2.0, f64::INFINITY), (3.0, 1.0)]),
            (false, vec![(0.0, -1e308), (1.0, 1e308)]),
            (true, vec![(0.0, 1e-300), (1.0, 1e300)]),
            // Values between two ticks of a logarithmic axis, and around one.
            (true, vec![(0.0, 0.055), (1.0, 0.095)]),
            (true, vec![(0.0, 0.0301), (1.0, 0.0299)]),
            (true, vec![(0.0, 0.95), (1.0, 1.05)]),
            (true, vec![(0.0, 0.021), (1.0, 0.099)]),
            (true, many),
        ] {
            let parts = vec![(0.5, "c < d".to_owned()), (f64::NAN, String::new()), (1e300, String::new())];
            let text = svg(&Plot { title: "a < b".into(), x_label: "x < y".into(), log_y, points, parts });
            assert!(text.starts_with("<svg") && text.trim_end().ends_with("</svg>"));
            assert!(
                !text.contains("NaN")
                    && !text.contains("inf")
                    && text.contains("a &lt; b")
                    && text.contains("x &lt; y")
                    && text.contains("c &lt; d"),
                "{text}"
            );
            // Labels of the vertical axis, and the name of the horizontal one.
            assert!(text.matches("text-anchor=\"end\"").count() > 2, "{text}");
            assert!(text.len() < 20_000, "{} bytes", text.len());
        }
    }
}
