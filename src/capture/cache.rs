//! Cache of the pictures of views within a memory budget, filled ahead of time on rayon's threads.

use std::collections::HashMap;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use super::images::reduced;
use super::{CaptureError, Photo, View, decode};

/// Most pictures that are under way ahead of time, however many threads there are: decoding takes memory as well.
const MOST_AHEAD: usize = 8;

/// Cache that decodes pictures in parallel and keeps them within a budget of bytes.
///
/// Pictures are kept until the budget is full and then stay: training visits the views in ever new random orders, for
/// which that hits as often as any policy, and evicting the least recent would hit less. One eighth of the budget is
/// left for pictures that were prefetched but cannot stay; each of those is handed out once. A budget too small for one
/// picture still prefetches one. Pictures that callers hold are not counted, nor is the temporary memory of decoding.
/// Every prefetched picture should be requested: one that cannot stay occupies its place until then.
///
/// Views are identified by name: use one cache per capture and size of pictures.
pub struct PhotoCache {
    shared: Arc<Shared>,
}

struct Shared {
    /// Cache whose pictures these are reduced from, and the scale of both sides; `None` if these are decoded.
    reduces: Option<(PhotoCache, f64)>,
    state: Mutex<State>,
    /// Signalled when a slot leaves `Decoding`.
    decoded: Condvar,
}

#[derive(Default)]
struct State {
    slots: HashMap<String, Slot>,
    /// Most bytes of all slots.
    budget: usize,
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
    /// Being decoded by a thread. That one may wait for a cache that this one reduces, whose threads wait for nothing.
    Decoding,
    Ready(Arc<Photo>),
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        // The state is consistent between any two statements that can panic.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn size_of(&self, view: &View) -> (u32, u32) {
        view.scaled_size(self.reduces.as_ref().map_or(1.0, |(_, scale)| *scale))
    }

    /// Makes the picture of a view.
    fn make(&self, view: &View) -> Result<Arc<Photo>, CaptureError> {
        let photo = match &self.reduces {
            None => decode(view)?,
            Some((whole, _)) => {
                let whole = whole.get(view)?;
                reduced(&whole, self.size_of(view))
            }
        };
        Ok(Arc::new(photo))
    }

    /// Makes the picture of a view whose slot is `Decoding` and stores it there; on failure the slot is removed.
    fn fill(&self, view: &View) -> Result<Arc<Photo>, CaptureError> {
        let photo = self.make(view);
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
    /// Most bytes of slots that stay, and of those that are handed out once.
    fn limits(&self) -> (usize, usize) {
        let passing = self.budget / 8;
        (self.budget - passing, passing)
    }

    /// Kind of room for a new picture: to stay (`true`), to be handed out once (`false`), or none.
    fn room(&self, bytes: usize) -> Option<bool> {
        let (kept, passing) = self.limits();
        if self.kept.saturating_add(bytes) <= kept {
            Some(true)
        } else if self.passing == 0 || self.passing.saturating_add(bytes) <= passing {
            Some(false)
        } else {
            None
        }
    }

    fn insert(&mut self, name: &str, slot: Slot) {
        *if slot.keep { &mut self.kept } else { &mut self.passing } += slot.bytes;
        self.slots.insert(name.to_owned(), slot);
    }

    fn remove(&mut self, name: &str) {
        if let Some(slot) = self.slots.remove(name) {
            *if slot.keep { &mut self.kept } else { &mut self.passing } -= slot.bytes;
        }
    }

    /// Whether the picture of a view is there to stay.
    fn has(&self, view: &View) -> bool {
        self.slots.get(&view.name).is_some_and(|slot| slot.keep && matches!(slot.progress, Progress::Ready(_)))
    }
}

/// Bytes of a picture of this width and height.
fn bytes_of((width, height): (u32, u32)) -> usize {
    (width as usize).saturating_mul(height as usize).saturating_mul(4)
}

impl PhotoCache {
    /// A cache that holds at most `budget` bytes of pictures (4 per pixel).
    #[must_use]
    pub fn new(budget: usize) -> Self {
        Self::of(None, budget)
    }

    /// A cache of the same pictures with both sides scaled by `scale`, below 1, rounded; of at most `budget` bytes in
    /// addition. Each is made from the picture of its view in this cache, which is decoded if it is not there, so that
    /// it is the same whatever either holds.
    #[must_use]
    pub fn reduced(&self, scale: f64, budget: usize) -> Self {
        Self::of(Some((Self { shared: Arc::clone(&self.shared) }, scale)), budget)
    }

    fn of(reduces: Option<(Self, f64)>, budget: usize) -> Self {
        let state = Mutex::new(State { budget, ..State::default() });
        Self { shared: Arc::new(Shared { reduces, state, decoded: Condvar::new() }) }
    }

    /// Least budget that keeps the pictures of all these views, with sides scaled by `scale`, in whatever order they
    /// are requested.
    #[must_use]
    pub fn budget_for(views: &[View], scale: f64) -> usize {
        let all = views.iter().map(|view| bytes_of(view.scaled_size(scale))).fold(0, usize::saturating_add);
        // An eighth is reserved for pictures that are handed out once.
        all.saturating_add(all.div_ceil(7))
    }

    /// Changes the budget. Pictures for which it has no room are dropped.
    pub fn set_budget(&self, budget: usize) {
        let mut state = self.shared.state();
        state.budget = budget;
        let (kept, passing) = state.limits();
        let mut held: Vec<_> = state.slots.iter().map(|(name, slot)| (name.clone(), slot.keep)).collect();
        held.sort_unstable();
        // Of slots that a thread is at work for, its result is dropped.
        for (name, keep) in held.into_iter().rev() {
            let exceeds = if keep { state.kept > kept } else { state.passing > passing };
            if exceeds {
                state.remove(&name);
            }
        }
    }

    /// Bytes held or reserved at present.
    #[must_use]
    pub fn bytes(&self) -> usize {
        let state = self.shared.state();
        state.kept + state.passing
    }

    /// Width and height of the picture of a view.
    #[must_use]
    pub fn size_of(&self, view: &View) -> (u32, u32) {
        self.shared.size_of(view)
    }

    /// Starts making the pictures of the `next` views, in this order, on other threads: as many as there are threads
    /// but at most eight, those under way included, and no more than there is room for. Pictures that are there to stay
    /// do not count. Returns at once; a failure is reported when the view is requested.
    pub fn prefetch<'v>(&self, next: impl IntoIterator<Item = &'v View>) {
        let missing = next.into_iter().filter(|view| !self.shared.state().has(view));
        for view in missing.take(rayon::current_num_threads().min(MOST_AHEAD)) {
            if !self.start(view) {
                return;
            }
        }
    }

    /// Starts making the picture of a view on another thread, unless it is under way; false if there is no room.
    fn start(&self, view: &View) -> bool {
        let bytes = bytes_of(self.size_of(view));
        {
            let mut state = self.shared.state();
            if state.slots.contains_key(&view.name) {
                return true;
            }
            let Some(keep) = state.room(bytes) else { return false };
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
            let _ = shared.fill(&view);
        });
        true
    }

    /// The picture of a view: kept, prefetched or made now.
    ///
    /// # Errors
    /// As [`decode`].
    pub fn get(&self, view: &View) -> Result<Arc<Photo>, CaptureError> {
        let mut state = self.shared.state();
        loop {
            let (keep, progress) = match state.slots.get_mut(&view.name) {
                Some(slot) => (slot.keep, &mut slot.progress),
                None => {
                    let bytes = bytes_of(self.size_of(view));
                    if state.room(bytes) != Some(true) {
                        drop(state);
                        return self.shared.make(view);
                    }
                    state.insert(&view.name, Slot { progress: Progress::Decoding, bytes, keep: true });
                    drop(state);
                    return self.shared.fill(view);
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
                        return self.shared.make(view);
                    }
                    *progress = Progress::Decoding;
                    drop(state);
                    return self.shared.fill(view);
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
    use super::super::{Capture, LoadOptions, open};
    use super::*;

    /// Bytes of a picture of [`captured`].
    const ONE: usize = 20 * 10 * 4;

    fn captured(count: usize) -> (Capture, tempfile::TempDir) {
        let folder = tempfile::tempdir().unwrap();
        write_capture(folder.path(), count, 20, 10);
        (open(folder.path(), &LoadOptions::default()).unwrap(), folder)
    }

    /// Runs `test` with this many threads to prefetch on.
    fn with_threads(threads: usize, test: impl FnOnce() + Send) {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(test);
    }

    #[test]
    fn stays_within_its_budget_and_always_answers() {
        let (capture, _folder) = captured(24);
        let next = |i: usize| (1..24).map(move |k| (i + k) % 24);
        // Budgets for no image, less than one image, some images, those with several that pass, and all of them.
        for budget in [0, ONE - 1, ONE * 6, ONE * 16, ONE * 100] {
            for threads in [1, 8] {
                let cache = PhotoCache::new(budget);
                with_threads(threads, || {
                    for round in 0..3 {
                        for (i, view) in capture.views.iter().enumerate() {
                            let photo = cache.get(view).unwrap();
                            cache.prefetch(next(i).map(|k| &capture.views[k]));
                            assert_eq!(*photo, decode(view).unwrap(), "view {i}, round {round}");
                            assert!(cache.bytes() <= budget.max(ONE), "{} bytes of {budget}", cache.bytes());
                        }
                    }
                });
                if budget > ONE {
                    let again = cache.get(&capture.views[0]).unwrap();
                    assert!(Arc::ptr_eq(&again, &cache.get(&capture.views[0]).unwrap()), "the first view stays");
                }
            }
        }
    }

    /// Pictures that are there to stay do not count.
    #[test]
    fn as_many_are_prefetched_as_have_threads_and_room() {
        let (capture, _folder) = captured(24);
        for (budget, threads, expected) in
            [(0, 8, 1), (ONE * 6, 8, 6), (ONE * 16, 1, 1), (ONE * 16, 3, 3), (ONE * 16, 12, MOST_AHEAD)]
        {
            with_threads(threads, || {
                let cache = PhotoCache::new(budget);
                cache.prefetch(&capture.views);
                assert_eq!(cache.bytes(), expected * ONE, "{budget}, {threads}");
            });
        }
        with_threads(2, || {
            let cache = PhotoCache::new(ONE * 16);
            // 13 of the 14 that have room to stay.
            capture.views[..13].iter().for_each(|view| drop(cache.get(view).unwrap()));
            cache.prefetch(&capture.views);
            assert_eq!(cache.bytes(), 15 * ONE);
            let state = cache.shared.state();
            let has = |i: usize| state.slots.contains_key(&capture.views[i].name);
            assert!(has(13) && has(14) && !has(15));
        });
    }

    /// Each is made from the larger one, which is read once if there is room for it.
    #[test]
    fn reduced_pictures_are_the_same_whatever_is_cached() {
        let (capture, _folder) = captured(4);
        let expected = |i: usize| reduced(&decode(&capture.views[i]).unwrap(), (5, 3));
        let expected: Vec<Photo> = (0..4).map(expected).collect();
        assert!(expected.iter().all(|photo| photo.rgba.len() == 4 * 5 * 3));
        let check = |small: &PhotoCache| {
            for (view, expected) in capture.views.iter().zip(&expected) {
                let photo = small.get(view).unwrap();
                small.prefetch(&capture.views);
                assert!(*photo == *expected && small.size_of(view) == (5, 3), "{}", view.name);
            }
        };
        let all = PhotoCache::budget_for(&capture.views, 1.0);
        let whole = PhotoCache::new(all);
        for (whole, budget) in
            [(&PhotoCache::new(0), 0), (&PhotoCache::new(0), all), (&PhotoCache::new(all / 2), 70), (&whole, all)]
        {
            check(&whole.reduced(0.27, budget));
        }
        assert_eq!(whole.bytes(), 4 * ONE);
        capture.views.iter().for_each(|view| std::fs::remove_file(view.source.path()).unwrap());
        for budget in [0, all] {
            check(&whole.reduced(0.27, budget));
        }
        assert!(PhotoCache::new(0).reduced(0.27, all).get(&capture.views[0]).is_err());
    }

    #[test]
    fn what_exceeds_a_smaller_budget_is_dropped() {
        let (capture, _folder) = captured(12);
        let cache = PhotoCache::new(PhotoCache::budget_for(&capture.views, 1.0));
        let get_all =
            || capture.views.iter().for_each(|view| assert_eq!(*cache.get(view).unwrap(), decode(view).unwrap()));
        for (budget, left, then) in [(ONE * 100, 0, 12), (ONE * 8, 7, 7), (ONE * 100, 7, 12), (0, 0, 0)] {
            cache.set_budget(budget);
            assert_eq!(cache.bytes(), left * ONE, "{budget}");
            get_all();
            assert_eq!(cache.bytes(), then * ONE, "{budget}");
        }
        cache.prefetch(&capture.views);
        cache.set_budget(0);
        assert_eq!(cache.bytes(), 0);
        get_all();
    }

    #[test]
    fn threads_share_one_decoding() {
        let (capture, _folder) = captured(2);
        let cache = PhotoCache::new(1 << 20);
        let photos: Vec<_> = std::thread::scope(|scope| {
            let threads: Vec<_> = (0..8).map(|_| scope.spawn(|| cache.get(&capture.views[0]).unwrap())).collect();
            threads.into_iter().map(|t| t.join().unwrap()).collect()
        });
        assert!(photos.iter().all(|p| Arc::ptr_eq(p, &photos[0])));
    }

    #[test]
    fn failures_reach_the_caller_every_time() {
        let (capture, _folder) = captured(2);
        let view = &capture.views[0];
        std::fs::remove_file(view.source.path()).unwrap();
        let cache = PhotoCache::new(1 << 20);
        for cache in [&cache, &cache.reduced(0.5, 1 << 20)] {
            cache.prefetch([view]);
            for _ in 0..2 {
                assert!(matches!(cache.get(view), Err(CaptureError::Io { .. })));
            }
            assert_eq!(cache.bytes(), 0);
        }
    }
}
