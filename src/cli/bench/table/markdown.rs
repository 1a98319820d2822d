//! The table as Markdown.

use std::collections::BTreeSet;
use std::fmt;

use centaur::format::one_line;

use super::{Masked, Note, Row, Section, Table};
use crate::cli::bench::protocol::Protocol;

/// Upper bound on notes below the table. Notes with numbers may differ for every job.
const MOST_NOTES: usize = 20;

/// Note, with the variants whose trainings gave it, and the scenes of each.
struct Said<'t> {
    text: &'t str,
    by: Vec<(&'t Section, &'t BTreeSet<String>)>,
}

impl Masked {
    /// Mark after a scene's name.
    fn mark(self) -> &'static str {
        match self {
            Self::None => "",
            Self::Some => ", partly masked",
            Self::All => ", masked",
        }
    }
}

impl Row {
    fn cells(&self) -> String {
        let number =
            |value: Option<f64>, decimals: usize| value.map_or("–".to_owned(), |v| format!("{v:.decimals$}"));
        let lpips = self.lpips.as_ref();
        [
            self.runs.to_string(),
            number(self.psnr, 2),
            number(self.ssim, 3),
            number(self.flip, 3),
            lpips.map_or("–", |l| &l.net).to_owned(),
            number(lpips.map(|l| l.normalized), 3),
            number(lpips.map(|l| l.unnormalized), 3),
            number(self.splats, 0),
            number(self.triangles, 0),
            number(self.total_floats.map(|v| v / 1e6), 2),
            number(self.file_bytes.map(|v| v / 1e6), 1),
            number(self.training_seconds, 1),
            number(self.seconds_per_iteration, 3),
            number(self.fps, 1),
        ]
        .join(" | ")
    }
}

impl Table {
    fn write_notes(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let all = self.said();
        if !all.is_empty() {
            writeln!(f, "\nNotes of the trainings:\n")?;
        }
        for Said { text, by } in all.iter().take(MOST_NOTES) {
            writeln!(f, "- {}: {}", one_line(&self.in_words(by)), one_line(text))?;
        }
        match all.len().saturating_sub(MOST_NOTES) {
            0 => Ok(()),
            more => writeln!(f, "- and {more} more, which table.json has"),
        }
    }

    /// Notes of all variants, in order of occurrence.
    fn said(&self) -> Vec<Said<'_>> {
        let mut all: Vec<Said<'_>> = vec![];
        for section in &self.variants {
            for Note { text, scenes } in &section.notes {
                match all.iter_mut().find(|said| said.text == text) {
                    Some(said) => said.by.push((section, scenes)),
                    None => all.push(Said { text, by: vec![(section, scenes)] }),
                }
            }
        }
        all
    }

    /// Names of the variants and scenes whose trainings gave a note; `all` if all did.
    fn in_words(&self, by: &[(&Section, &BTreeSet<String>)]) -> String {
        let is_of_all = |section: &Section, scenes: &BTreeSet<String>| scenes.len() == section.rows.len();
        if by.len() == self.variants.len() && by.iter().all(|(section, scenes)| is_of_all(section, scenes)) {
            return "all".to_owned();
        }
        // Variants by their scenes.
        let mut groups: Vec<(String, Vec<&str>)> = vec![];
        for (section, scenes) in by {
            let scenes = if is_of_all(section, scenes) {
                "all scenes".to_owned()
            } else {
                scenes.iter().map(String::as_str).collect::<Vec<_>>().join(", ")
            };
            match groups.iter_mut().find(|(known, _)| *known == scenes) {
                Some((_, variants)) => variants.push(&section.variant),
                None => groups.push((scenes, vec![section.variant.as_str()])),
            }
        }
        let group = |(scenes, variants): &(String, Vec<&str>)| format!("{}, {scenes}", variants.join(" and "));
        groups.iter().map(group).collect::<Vec<_>>().join("; ")
    }
}

/// Formats the table as Markdown.
impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sizes = match self.protocol {
            Some(Protocol::A) => {
                "Scenes of Mip-NeRF 360 at the image sizes of protocol A (images of the data set), others as they are; SSIM in the table uses only windows inside the image, whatever is stated next"
            }
            Some(Protocol::B) => {
                "Scenes of Mip-NeRF 360 at the image sizes of protocol B (full-size images scaled down here), others as they are"
            }
            None => "Images of the size given by the flags",
        };
        writeln!(f, "{sizes}; {}.", self.scores)?;
        writeln!(f, "Adapter: {}.", self.adapters.iter().map(String::as_str).collect::<Vec<_>>().join("; "))?;
        for Section { variant, flags, .. } in self.variants.iter().filter(|section| !section.flags.is_empty()) {
            writeln!(f, "Flags of {variant}: `{}`.", flags.join(" "))?;
        }
        for Section { variant, scene_flags, .. } in &self.variants {
            for flags in scene_flags.values().collect::<BTreeSet<_>>() {
                let alike = scene_flags.iter().filter(|(_, own)| *own == flags);
                let scenes: Vec<&str> = alike.map(|(scene, _)| scene.as_str()).collect();
                writeln!(f, "Flags of {variant} for {}: `{}`.", scenes.join(", "), flags.join(" "))?;
            }
        }
        writeln!(
            f,
            "\n| variant | scene | runs | PSNR | SSIM | FLIP | LPIPS by | LPIPS −1…1 | LPIPS 0…1 | splats | triangles | M floats | MB | training, s | s/joint iteration | fps |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|")?;
        for section in &self.variants {
            for row in &section.rows {
                // A scene may have any name that a folder can have.
                let scene = one_line(&row.scene).replace('|', "\\|");
                writeln!(f, "| {} | {scene}{} | {} |", section.variant, row.masked.mark(), row.cells())?;
            }
            if let Some(mean) = &section.mean {
                let name = [&mean.scene, mean.masked.mark()].concat();
                writeln!(f, "| **{}** | **{name}** | {} |", section.variant, mean.cells())?;
            }
        }
        let number = |value: Option<f64>| value.map_or("–".to_owned(), |v| v.to_string());
        for p in &self.published {
            let (lpips, net) = (number(p.lpips), if p.lpips.is_some() { "vgg" } else { "–" });
            // Each source has LPIPS by one convention.
            let (a, b) = if p.lpips_normalized { (&*lpips, "–") } else { ("–", &*lpips) };
            let over = p.over.map_or("published".to_owned(), |over| format!("published: {over}"));
            writeln!(
                f,
                "| *{}* | {over} | | {} | {} | | {net} | {a} | {b} | | | | | | | |",
                p.method,
                p.psnr,
                number(p.ssim)
            )?;
        }
        if self.variants.iter().flat_map(|section| &section.rows).any(|row| row.masked != Masked::None) {
            writeln!(
                f,
                "\nMasked rows: photographs and renders are multiplied by masks; in partly masked rows, those of views that have a mask. Such scores do not compare \
                 with others: there is no mean over both, and no published row beside them."
            )?;
        }
        if self.variants.iter().flat_map(|section| &section.rows).any(|row| row.psnr == Some(f64::INFINITY)) {
            writeln!(
                f,
                "\nPSNR of inf: in 8 bits, a view is equal to its photograph, so that there is no finite mean."
            )?;
        }
        if let Some(note) = self.published_note {
            writeln!(f, "\nPublished rows: {note}.")?;
        }
        self.write_notes(f)
    }
}
