//! Photographs on the adapter: the one that a step compares its picture with, and those that are kept to avoid
//! uploading them in every epoch.

use std::{collections::HashMap, sync::Arc};

use super::device::{Buffer, Frame, Gpu, GpuError};

/// The photograph that a step compares its picture with.
pub(crate) enum Truth<'a> {
    /// Sent to the adapter: RGBA8, `[h·w·4]`, and the number under which it stays there if there is room. One number
    /// and size must always mean the same photograph.
    Sent { rgba: &'a [u8], number: Option<usize> },
    /// Kept on the adapter, see [`UploadedPhotographs::kept`].
    Kept(Arc<Buffer>),
}

/// Photographs on the adapter in RGBA8.
pub(crate) struct UploadedPhotographs {
    /// Photograph that the loss reads, `[h·w]`.
    pub(crate) shown: Buffer,
    kept: Kept,
}

/// Photographs kept on the adapter.
#[derive(Default)]
struct Kept {
    /// Bytes and buffer of each photograph, by number.
    photographs: HashMap<usize, (u64, Arc<Buffer>)>,
    /// Bytes still available for more.
    room: u64,
}

impl UploadedPhotographs {
    /// Room for photographs of up to `pixels` pixels. None are kept yet.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn new(gpu: &Gpu, pixels: usize) -> Result<Self, GpuError> {
        Ok(Self { shown: gpu.storage("photograph", pixels)?, kept: Kept::default() })
    }

    /// Keeps photographs that have a number from now on, up to this many bytes.
    pub(crate) fn keep(&mut self, bytes: u64) {
        self.kept = Kept { photographs: HashMap::new(), room: bytes };
    }

    /// The photograph of this number, if it is kept and has this many bytes.
    pub(crate) fn kept(&self, number: usize, bytes: u64) -> Option<Arc<Buffer>> {
        let (of, kept) = self.kept.photographs.get(&number)?;
        (*of == bytes).then(|| Arc::clone(kept))
    }

    /// Sets the photograph for the rest of the frame.
    pub(crate) fn show(&mut self, gpu: &Gpu, frame: &mut Frame, truth: &Truth) {
        match *truth {
            Truth::Kept(ref kept) => frame.copy(kept, &self.shown),
            Truth::Sent { rgba, number } => match number.and_then(|number| self.kept.get(gpu, rgba, number)) {
                Some(kept) => frame.copy(kept, &self.shown),
                None => gpu.write(&self.shown, 0, rgba),
            },
        }
    }
}

impl Kept {
    /// The kept photograph of this number, uploaded if it is not there yet; `None` if there is no room.
    fn get(&mut self, gpu: &Gpu, rgba: &[u8], number: usize) -> Option<&Buffer> {
        let bytes = rgba.len() as u64;
        // Pictures grow during coarse-to-fine training.
        if let Some(of_before) = self.photographs.get(&number).map(|(bytes, _)| *bytes).filter(|b| *b != bytes) {
            self.photographs.remove(&number);
            self.room += of_before;
        }
        if !self.photographs.contains_key(&number) {
            let left = self.room.checked_sub(bytes)?;
            let Ok(buffer) = gpu.storage("kept photograph", rgba.len() / 4) else {
                // The remaining memory is needed for other things.
                self.room = 0;
                return None;
            };
            gpu.write(&buffer, 0, rgba);
            self.room = left;
            self.photographs.insert(number, (bytes, Arc::new(buffer)));
        }
        self.photographs.get(&number).map(|(_, buffer)| buffer.as_ref())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_kept_is_sent_once() {
        let gpu = Gpu::open(None).unwrap();
        let mut photographs = UploadedPhotographs::new(&gpu, 16).unwrap();
        let show = |photographs: &mut UploadedPhotographs, value: u8, bytes: usize, number: Option<usize>| {
            let mut frame = Frame::new(&gpu);
            photographs.show(&gpu, &mut frame, &Truth::Sent { rgba: &vec![value; bytes], number });
            frame.submit();
            let shown: Vec<u8> = gpu.read(&photographs.shown, 64).unwrap();
            assert!(shown[..bytes].iter().all(|v| *v == shown[0]));
            shown[0]
        };
        // Without capacity every photograph is uploaded.
        assert_eq!([(1, 0), (2, 0)].map(|(v, n)| show(&mut photographs, v, 64, Some(n))), [1, 2]);
        photographs.keep(150);
        // Different content under the same number would show if it were uploaded again. There is no room for the third
        // photograph, and photographs without a number are not kept.
        let shown = [(3, Some(0)), (4, Some(1)), (5, Some(0)), (6, Some(1)), (7, Some(2)), (8, Some(2)), (9, None)];
        assert_eq!(shown.map(|(v, n)| show(&mut photographs, v, 64, n)), [3, 4, 3, 4, 7, 8, 9]);
        let kept =
            [(0, 64), (1, 64), (2, 64), (0, 16)].map(|(number, bytes)| photographs.kept(number, bytes).is_some());
        assert_eq!(kept, [true, true, false, false]);
        let (mut frame, kept) = (Frame::new(&gpu), photographs.kept(1, 64).unwrap());
        photographs.show(&gpu, &mut frame, &Truth::Kept(kept));
        frame.submit();
        assert_eq!(gpu.read::<u8>(&photographs.shown, 64).unwrap(), [4; 64]);
        // A photograph of another size replaces the previous one with its number, and the space freed can hold others.
        let shown = [(10, 16, 1), (11, 16, 1), (12, 64, 2), (13, 64, 2), (14, 64, 1), (15, 64, 1)];
        assert_eq!(shown.map(|(v, bytes, n)| show(&mut photographs, v, bytes, Some(n))), [10, 10, 12, 12, 14, 15]);
        photographs.keep(0);
        assert_eq!(show(&mut photographs, 16, 64, Some(0)), 16);
    }
}
