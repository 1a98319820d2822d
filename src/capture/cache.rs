//! Cache of decoded pictures within a memory budget, filled ahead of time on rayon's threads.

use std::collections::HashMap;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use super::{CaptureError, Photo, View, decode};

/// Cache that decodes pictures in parallel and keeps them within a budget of bytes.
///
/// Pictures are kept until the budget is full and then stay: training visits the views in ever new random orders, for
/// which that hits as often as any policy, and evicting the least recent would hit less. One eighth of the budget is
/// left for pictures that were prefetched but cannot stay; each of those is handed out once. A budget too small for one
/// picture still prefetches one. Pictures that callers hold are not counted, nor is the temporary memory of decoding.
/// Every prefetched picture should be requested: one that cannot stay occupies its place until then.
///
/// Views are identified by name: use one cache per capture.
pub struct PhotoCache {
    shared: Arc<Shared>,
}

struct Shared {
    budget: usize,
    state: Mutex<State>,
    /// Signalled when a slot leaves `Decoding`.
    decoded: Condvar,
}

#[derive(Default)]
struct State {
    slots: HashMap<String, Slot>,
    /// Bytes of slots that stay, decoded or reserved.
    kept: usize,
    /// Bytes of slots that are handed out once, decoded or reserved.
    passing: usize,
}

struct Slot {
    progress: Progress,
    bytes: usize,
    keep: bool,
}

enum Progress {
    /// Waiting for a thread. `get` takes the job over instead of waiting for it, so it never waits for a pool that may
    /// be waiting for it.
    Queued,
    /// Being decoded by a thread.
    Decoding,
    Ready(Arc<Photo>),
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        // The state is consistent between any two statements that can panic.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Kind of room for a new picture: to stay (`true`), to be handed out once (`false`), or none.
    fn room(&self, state: &State, bytes: usize) -> Option<bool> {
        let passing = self.budget / 8;
        if state.kept.saturating_add(bytes) <= self.budget - passing {
            Some(true)
        } else if state.passing == 0 || state.passing.saturating_add(bytes) <= passing {
            Some(false)
        } else {
            None
        }
    }

    /// Decodes a view whose slot is `Decoding` and stores the picture there; on failure the slot is removed.
    fn decode(&self, view: &View) -> Result<Arc<Photo>, CaptureError> {
        let photo = decode(view).map(Arc::new);
        let mut state = self.state();
        match &photo {
            Ok(photo) => {
                if let Some(slot) = state.slots.get_mut(&view.name) {
                    slot.progress = Progress::Ready(Arc::clone(photo));
                }
            }
            Err(_) => state.remove(&view.name),
        }
        self.decoded.notify_all();
        photo
    }
}

impl State {
    fn insert(&mut self, name: &str, slot: Slot) {
        *if slot.keep { &mut self.kept } else { &mut self.passing } += slot.bytes;
        self.slots.insert(name.to_owned(), slot);
    }

    fn remove(&mut self, name: &str) {
        if let Some(slot) = self.slots.remove(name) {
            *if slot.keep { &mut self.kept } else { &mut self.passing } -= slot.bytes;
        }
    }
}

/// Bytes of a view's decoded picture.
fn photo_bytes(view: &View) -> usize {
    let k = view.camera.intrinsics();
    (k.width as usize).saturating_mul(k.height as usize).saturating_mul(4)
}

impl PhotoCache {
    /// A cache that holds at most `budget` bytes of pictures (4 per pixel).
    #[must_use]
    pub fn new(budget: usize) -> Self {
        Self { shared: Arc::new(Shared { budget, state: Mutex::default(), decoded: Condvar::new() }) }
    }

    /// Least budget that keeps all pictures of these views, in whatever order they are requested.
    #[must_use]
    pub fn budget_for(views: &[View]) -> usize {
        let all = views.iter().map(photo_bytes).fold(0, usize::saturating_add);
        // An eighth is reserved for pictures that are handed out once.
        all.saturating_add(all.div_ceil(7))
    }

    /// Largest number of bytes of pictures held.
    #[must_use]
    pub fn budget(&self) -> usize {
        self.shared.budget
    }

    /// Bytes held or reserved at present.
    #[must_use]
    pub fn bytes(&self) -> usize {
        let state = self.shared.state();
        state.kept + state.passing
    }

    /// Starts decoding a view on another thread, if there is room for it. Returns at once; a failure is reported when
    /// the view is requested.
    pub fn prefetch(&self, view: &View) {
        let bytes = photo_bytes(view);
        {
            let mut state = self.shared.state();
            if state.slots.contains_key(&view.name) {
                return;
            }
            let Some(keep) = self.shared.room(&state, bytes) else { return };
            state.insert(&view.name, Slot { progress: Progress::Queued, bytes, keep });
        }
        let (shared, view) = (Arc::clone(&self.shared), view.clone());
        rayon::spawn(move || {
            let mut state = shared.state();
            match state.slots.get_mut(&view.name) {
                Some(slot) if matches!(slot.progress, Progress::Queued) => slot.progress = Progress::Decoding,
                _ => return,
            }
            drop(state);
            // The error recurs in `get`, for its caller.
            let _ = shared.decode(&view);
        });
    }

    /// The picture of a view: kept, prefetched or decoded now.
    ///
    /// # Errors
    /// As [`decode`].
    pub fn get(&self, view: &View) -> Result<Arc<Photo>, CaptureError> {
        let mut state = self.shared.state();
        loop {
            let (keep, progress) = match state.slots.get_mut(&view.name) {
                Some(slot) => (slot.keep, &mut slot.progress),
                None => {
                    let bytes = photo_bytes(view);
                    if self.shared.room(&state, bytes) != Some(true) {
                        drop(state);
                        return decode(view).map(Arc::new);
                    }
                    state.insert(&view.name, Slot { progress: Progress::Decoding, bytes, keep: true });
                    drop(state);
                    return self.shared.decode(view);
                }
            };
            match progress {
                Progress::Ready(photo) => {
                    let photo = Arc::clone(photo);
                    if !keep {
                        state.remove(&view.name);
                    }
                    return Ok(photo);
                }
                Progress::Queued => {
                    if !keep {
                        state.remove(&view.name);
                        drop(state);
                        return decode(view).map(Arc::new);
                    }
                    *progress = Progress::Decoding;
                    drop(state);
                    return self.shared.decode(view);
                }
                Progress::Decoding => {
                    state = self.shared.decoded.wait(state).unwrap_or_else(PoisonError::into_inner);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::write_capture;
    use super::super::{LoadOptions, open};
    use super::*;

    #[test]
    fn stays_within_its_budget_and_always_answers() {
        let folder = tempfile::tempdir().unwrap();
        write_capture(folder.path(), 12, 20, 10);
        let capture = open(folder.path(), &LoadOptions::default()).unwrap();
        let one = 20 * 10 * 4;
        // Budgets for no image, less than one image, some images, and all of them.
        for budget in [0, one - 1, one * 6, one * 100] {
            let cache = PhotoCache::new(budget);
            for round in 0..3 {
                for (i, view) in capture.views.iter().enumerate() {
                    cache.prefetch(&capture.views[(i + 1) % 12]);
                    cache.prefetch(&capture.views[(i + 2) % 12]);
                    let photo = cache.get(view).unwrap();
                    assert_eq!(*photo, decode(view).unwrap(), "view {i}, round {round}");
                    assert!(cache.bytes() <= budget.max(one), "{} bytes of {budget}", cache.bytes());
                }
            }
            if budget > one {
                let again = cache.get(&capture.views[0]).unwrap();
                assert!(Arc::ptr_eq(&again, &cache.get(&capture.views[0]).unwrap()), "the first view stays");
            }
        }
    }

    #[test]
    fn threads_share_one_decoding() {
        let folder = tempfile::tempdir().unwrap();
        write_capture(folder.path(), 2, 20, 10);
        let view = open(folder.path(), &LoadOptions::default()).unwrap().views.remove(0);
        let cache = PhotoCache::new(1 << 20);
        let photos: Vec<_> = std::thread::scope(|scope| {
            let threads: Vec<_> = (0..8).map(|_| scope.spawn(|| cache.get(&view).unwrap())).collect();
            threads.into_iter().map(|t| t.join().unwrap()).collect()
        });
        assert!(photos.iter().all(|p| Arc::ptr_eq(p, &photos[0])));
    }

    #[test]
    fn failures_reach_the_caller_every_time() {
        let folder = tempfile::tempdir().unwrap();
        write_capture(folder.path(), 2, 20, 10);
        let view = open(folder.path(), &LoadOptions::default()).unwrap().views.remove(0);
        std::fs::remove_file(view.source.path()).unwrap();
        let cache = PhotoCache::new(1 << 20);
        cache.prefetch(&view);
        for _ in 0..2 {
            assert!(matches!(cache.get(&view), Err(CaptureError::Io { .. })));
        }
        assert_eq!(cache.bytes(), 0);
    }
}
