//! Limit on the memory of a file's maps: images of one colour are stored in almost no bytes, and many surfaces may
//! share one.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hasher as _};

/// Bytes of maps allowed per stored byte, beyond the amount that any file may use (`ALWAYS`): four floats per pixel, of
/// which a PNG holds up to a thousand in a byte.
pub(super) const MAX_RATIO: u64 = 16384;
pub(super) const ALWAYS: u64 = 1 << 30;

/// Expectation and finding.
type Mismatch = (String, String);

/// Identity of an encoded image: hash and length.
pub(super) type Identity = (u64, u64);

/// Identity of an encoded image.
pub(super) fn identity(encoded: &[u8]) -> Identity {
    let mut hasher = DefaultHasher::new();
    hasher.write(encoded);
    (hasher.finish(), encoded.len() as u64)
}

/// Bytes of maps so far, and the stored bytes from which they come.
pub(super) struct MapBudget {
    bytes: u64,
    stored: u64,
    images: HashMap<u64, u64>,
}

impl MapBudget {
    /// Creates the budget; `stored`: bytes from which maps come, besides images.
    pub(super) fn new(stored: u64) -> Self {
        Self { bytes: 0, stored, images: HashMap::new() }
    }

    /// Budget of a single image.
    pub(super) fn of(encoded: &[u8]) -> Self {
        Self::new(encoded.len() as u64)
    }

    /// Includes an image from which maps come; repeated images count once.
    pub(super) fn include(&mut self, image: Identity) {
        self.images.extend([image]);
    }

    /// Reserves a map of `floats` floats before it is allocated, or refuses it.
    pub(super) fn spend(&mut self, floats: u64) -> Result<(), Mismatch> {
        self.bytes = self.bytes.saturating_add(floats.saturating_mul(4));
        let images: u64 = self.images.values().sum();
        let most = ALWAYS.saturating_add(MAX_RATIO.saturating_mul(self.stored.saturating_add(images)));
        if self.bytes <= most {
            return Ok(());
        }
        Err((format!("maps of at most {most} bytes from images of this size"), format!("{} bytes", self.bytes)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_many_share_counts_once() {
        let image = identity(&[7; 1000]);
        let (mut own, mut shared) = (MapBudget::new(0), MapBudget::new(0));
        let floats = (ALWAYS + 1000 * MAX_RATIO) / 4;
        own.include(image);
        own.spend(floats).unwrap();
        own.include(identity(&[8; 1000]));
        own.spend(1000 * MAX_RATIO / 4).unwrap();
        for _ in 0..2 {
            shared.include(image);
        }
        shared.spend(floats).unwrap();
        let (expected, found) = shared.spend(1).unwrap_err();
        assert_eq!(expected, "maps of at most 1090125824 bytes from images of this size");
        assert_eq!(found, "1090125828 bytes");
        assert!(MapBudget::of(&[]).spend(u64::MAX).is_err());
    }
}
