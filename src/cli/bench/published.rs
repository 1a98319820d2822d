//! Published results on whole data sets, as plain figures with their provenance.

use std::{collections::BTreeSet, ops::RangeInclusive};

use super::protocol::{MIPNERF360, Protocol};

/// Means over a data set, taken by one protocol.
pub(super) struct Known {
    /// Exact set of scenes over which the means are taken.
    scenes: &'static [&'static str],
    pictures: Pictures,
    /// Range of the images' longer sides in pixels.
    longer_side: RangeInclusive<u64>,
    /// Source and conventions of the means, for below the table.
    pub(super) note: &'static str,
    /// Whether LPIPS, by VGG, uses colours −1…1; otherwise 0…1.
    pub(super) normalized: bool,
    pub(super) means: &'static [Mean],
}

/// Size of the images.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Pictures {
    Of(Protocol),
    /// Distributed size; SSIM as INRIA computes it.
    Distributed,
    /// Partly distributed size, partly scaled to about the same size; SSIM as INRIA computes it.
    Sized,
}

#[derive(Clone, Copy)]
pub(super) struct Mean {
    pub(super) method: &'static str,
    /// Description of the images or scenes, if other than the data set's.
    pub(super) over: Option<&'static str>,
    pub(super) psnr: f64,
    pub(super) ssim: Option<f64>,
    /// LPIPS; none if it is not published, or only by an unstated convention.
    pub(super) lpips: Option<f64>,
}

const fn mean(method: &'static str, [psnr, ssim, lpips]: [f64; 3]) -> Mean {
    Mean { method, over: None, psnr, ssim: Some(ssim), lpips: Some(lpips) }
}

const fn partly(method: &'static str, psnr: f64, ssim: Option<f64>) -> Mean {
    Mean { method, over: None, psnr, ssim, lpips: None }
}

/// Mean that seems to be for protocol A's images although listed in tables of protocol B: the methods' own papers have
/// these figures, and `NerfBaselines` about the same.
const fn other_pictures(method: &'static str, figures: [f64; 3]) -> Mean {
    Mean { over: Some("pictures of the data set, as it seems"), ..mean(method, figures) }
}

/// Mean from HERA's paper, which does not name its five scenes of Tanks and Temples.
const fn of_five(method: &'static str, figures: [f64; 3]) -> Mean {
    Mean { over: Some("five scenes, unnamed"), ..mean(method, figures) }
}

const OF_FIVE: [Mean; 5] = [
    of_five("Mip-NeRF 360", [23.61, 0.765, 0.283]),
    of_five("3DGS, retrained", [24.01, 0.814, 0.228]),
    of_five("Mip-Splatting", [24.21, 0.822, 0.216]),
    of_five("HERA", [24.29, 0.822, 0.207]),
    of_five("HERA, filtered", [24.39, 0.824, 0.206]),
];

const fn names<const N: usize>(of: &[(&'static str, u32); N]) -> [&'static str; N] {
    let mut names = [""; N];
    let mut i = 0;
    while i < N {
        names[i] = of[i].0;
        i += 1;
    }
    names
}

const OF_MIPNERF360: [&str; MIPNERF360.len()] = names(&MIPNERF360);

/// A quarter of 4946 to 5187 pixels outdoors, and half of 3114 to 3118 indoors.
const OF_EITHER_PROTOCOL: RangeInclusive<u64> = 1226..=1570;

static KNOWN: [Known; 5] = [
    Known {
        scenes: &OF_MIPNERF360,
        pictures: Pictures::Of(Protocol::B),
        longer_side: OF_EITHER_PROTOCOL,
        note: "the nine scenes of Mip-NeRF 360 as the paper of HERA prints them; LPIPS by VGG of colours 0…1",
        normalized: false,
        means: &[
            other_pictures("Mip-NeRF 360", [27.57, 0.793, 0.234]),
            other_pictures("Zip-NeRF", [28.54, 0.828, 0.189]),
            mean("3DGS, retrained", [27.70, 0.826, 0.202]),
            mean("Mip-Splatting", [27.79, 0.827, 0.205]),
            mean("HERA", [27.61, 0.828, 0.199]),
            mean("HERA, filtered", [27.75, 0.829, 0.194]),
        ],
    },
    Known {
        scenes: &OF_MIPNERF360,
        pictures: Pictures::Of(Protocol::A),
        longer_side: OF_EITHER_PROTOCOL,
        note: "the nine scenes of Mip-NeRF 360 as `NerfBaselines` scores them; LPIPS by VGG of colours −1…1",
        normalized: true,
        means: &[
            mean("Zip-NeRF", [28.553, 0.829, 0.218]),
            mean("3DGS-MCMC", [27.983, 0.835, 0.224]),
            mean("Scaffold-GS", [27.714, 0.813, 0.262]),
            mean("Mip-NeRF 360", [27.681, 0.792, 0.272]),
            mean("Mip-Splatting", [27.492, 0.815, 0.258]),
            mean("3DGS", [27.434, 0.814, 0.257]),
            mean("2DGS", [26.815, 0.796, 0.297]),
        ],
    },
    Known {
        scenes: &["train", "truck"],
        pictures: Pictures::Distributed,
        longer_side: 970..=990,
        note: "train and truck of Tanks and Temples as they come (about 980×546), from papers and READMEs of the methods, gsplat's from a survey of compression; \
               LPIPS by VGG of colours 0…1, – where none is known of that convention. Rows of five scenes are from HERA's paper, which does not name \
               them: such means do not compare with those of two. nvs-bench's row is over scenes that were not checked",
        normalized: false,
        means: &[
            mean("3DGS", [23.14, 0.841, 0.183]),
            mean("Scaffold-GS", [23.96, 0.853, 0.177]),
            mean("Mini-Splatting-D", [23.23, 0.853, 0.140]),
            mean("Taming 3DGS, large", [24.04, 0.851, 0.170]),
            mean("Octree-GS", [24.68, 0.866, 0.153]),
            mean("gsplat, 4 M splats", [24.47, 0.872, 0.132]),
            partly("3DGS-MCMC", 24.29, Some(0.86)),
            partly("Beta Splatting", 24.85, Some(0.870)),
            partly("NeST-Splatting", 23.02, None),
            partly("MeshSplatting", 20.52, None),
            Mean { over: Some("nvs-bench, scenes not checked"), ..partly("Brush", 24.531, Some(0.8709)) },
            OF_FIVE[0],
            OF_FIVE[1],
            OF_FIVE[2],
            OF_FIVE[3],
            OF_FIVE[4],
        ],
    },
    Known {
        scenes: &["Barn", "Caterpillar", "Ignatius", "train", "truck"],
        pictures: Pictures::Sized,
        // About half of the larger three's, all of truck's 979 and train's 980.
        longer_side: 950..=1000,
        note: "five scenes of Tanks and Temples as HERA's paper prints them, which does not name them: whether they are these is not known; LPIPS by \
               VGG of colours 0…1",
        normalized: false,
        means: &OF_FIVE,
    },
    Known {
        scenes: &["drjohnson", "playroom"],
        pictures: Pictures::Distributed,
        longer_side: 1254..=1342,
        note: "Deep Blending by nvs-bench, over scenes that were not checked; its LPIPS, 0.312, is of a convention that is not said",
        normalized: false,
        means: &[Mean { over: Some("nvs-bench, scenes not checked"), ..partly("Brush", 29.85, Some(0.911)) }],
    },
];

/// Published means for exactly these scenes, with images of these longer sides. `resized`: flags determine the images
/// or their size. `masked`: masks multiplied some images, which no published result does.
pub(super) fn of(
    scenes: &BTreeSet<String>,
    protocol: Option<Protocol>,
    resized: bool,
    masked: bool,
    longer_sides: &BTreeSet<u64>,
) -> Option<&'static Known> {
    KNOWN.iter().find(|known| {
        let is_so = match known.pictures {
            Pictures::Of(wanted) => protocol == Some(wanted),
            // Protocol A takes SSIM over windows inside the image.
            Pictures::Distributed => protocol != Some(Protocol::A) && !resized,
            Pictures::Sized => protocol != Some(Protocol::A),
        };
        let are_so_long = longer_sides.iter().all(|side| known.longer_side.contains(side));
        is_so
            && !masked
            && are_so_long
            && scenes.len() == known.scenes.len()
            && known.scenes.iter().all(|name| scenes.contains(*name))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn five_scenes_of_tanks_and_temples_stand_beside_heras() {
        let of_masks = |names: &[&str], side: u64, masked: bool| {
            let scenes = names.iter().map(|name| (*name).to_owned()).collect();
            // The three larger scenes are downscaled by a per-scene flag.
            of(&scenes, None, names.len() > 2, masked, &BTreeSet::from([side])).map(|known| known.means.len())
        };
        let rows = |names: &[&str], side: u64| of_masks(names, side, false);
        assert_eq!(rows(&["Barn", "Caterpillar", "Ignatius", "train", "truck"], 979), Some(5));
        assert_eq!(rows(&["Barn", "Caterpillar", "Ignatius", "train", "truck"], 1957), None);
        assert_eq!(rows(&["train", "truck"], 980), Some(16));
        assert_eq!(rows(&["Barn", "train"], 979), None);
        assert_eq!(of_masks(&["Barn", "Caterpillar", "Ignatius", "train", "truck"], 979, true), None);
    }
}
