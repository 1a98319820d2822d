//! What stands in `meta.json`.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::format::error::shown;
use crate::format::splat_record::SEEN_IN_3D;

/// `meta.json` of both versions.
#[derive(Serialize, Deserialize)]
pub(super) struct Meta {
    /// 2; absent from version 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) version: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) asset: Option<Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) count: Option<u64>,
    /// Version 2: splats are to keep their integral over a picture.
    #[serde(default, skip_serializing_if = "is_false")]
    pub(super) antialias: bool,
    /// What splat-transform has written in its place since 3.2: `default`, `antialiased` or `2dgs`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) model: Option<Value>,
    pub(super) means: Field,
    pub(super) scales: Field,
    pub(super) quats: Field,
    pub(super) sh0: Field,
    #[serde(rename = "shN", skip_serializing_if = "Option::is_none")]
    pub(super) sh_n: Option<Field>,
    /// What else there is, of which splats know nothing.
    #[serde(flatten)]
    pub(super) rest: Map<String, Value>,
}

fn is_false(value: &bool) -> bool {
    !value
}

/// An attribute: its images, and what their bytes mean.
#[derive(Default, Serialize, Deserialize)]
pub(super) struct Field {
    /// Version 1: number of splats, then of components.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) shape: Option<Vec<u64>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) mins: Option<Numbers>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) maxs: Option<Numbers>,
    /// Version 2. Some writers have put `null` in the first place.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) codebook: Option<Vec<Option<f32>>>,
    /// Entries of the palette.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) count: Option<u64>,
    /// SH degree.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) bands: Option<u32>,
    pub(super) files: Vec<String>,
}

#[derive(Serialize, Deserialize)]
#[serde(untagged)]
pub(super) enum Numbers {
    One(f64),
    Many(Vec<f64>),
}

impl Numbers {
    pub(super) fn get(&self, i: usize) -> Option<f64> {
        match self {
            Self::One(v) => Some(*v),
            Self::Many(values) => values.get(i).copied(),
        }
    }
}

impl Meta {
    /// Names of the images: lower and upper bytes of the means, scales, rotations, colours; entries and labels of the
    /// palette.
    pub(super) fn files(&self) -> Vec<&str> {
        let fields = [&self.means, &self.scales, &self.quats, &self.sh0].into_iter().chain(&self.sh_n);
        fields.flat_map(|field| field.files.iter().map(String::as_str)).collect()
    }

    /// Whether splats are to keep their integral over a picture; and a sentence where they are to be seen as nothing here shows them.
    pub(super) fn antialiased(&self) -> (bool, Option<String>) {
        let Some(model) = &self.model else { return (self.antialias, None) };
        match model.as_str() {
            Some("antialiased") => (true, None),
            Some("default") => (false, None),
            Some("2dgs") => (false, Some(format!("model 2dgs: {SEEN_IN_3D}"))),
            name => {
                let name = name.map_or_else(|| model.to_string(), str::to_owned);
                (self.antialias, Some(format!("model {}: not known, left out", shown(name.as_bytes()))))
            }
        }
    }
}
