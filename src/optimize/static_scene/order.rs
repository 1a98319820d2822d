//! Order in which a phase trains on its views.

use std::cell::RefCell;

use rand::seq::SliceRandom;

use super::{Phase, setup::Setup};
use crate::optimize::random::{self, Purpose};

/// Order in which a phase trains on its views: every epoch is a permutation of them.
pub(super) struct ViewOrder {
    /// Indices in the capture, at least one.
    views: Vec<usize>,
    seed: u64,
    phase: Phase,
    /// The epochs last asked for, one of even and one of odd number: steps look ahead into the next one.
    epochs: RefCell<[Epoch; 2]>,
}

/// An epoch's permutation of the views; empty before it is asked for.
#[derive(Default)]
struct Epoch {
    number: u32,
    views: Vec<usize>,
}

impl ViewOrder {
    /// Of the views that a phase trains on.
    pub(super) fn of(setup: &Setup, phase: Phase) -> Self {
        let views = if phase == Phase::Warmup { setup.warming_views() } else { setup.train.clone() };
        Self::new(views, setup.options.seed, phase)
    }

    fn new(views: Vec<usize>, seed: u64, phase: Phase) -> Self {
        Self { views, seed, phase, epochs: RefCell::default() }
    }

    /// Number of views.
    pub(super) fn len(&self) -> u32 {
        self.views.len() as u32
    }

    /// View of iteration `age` of the splats, or of the warm-up.
    pub(super) fn at(&self, age: u32) -> usize {
        let (number, place) = (age / self.len(), age % self.len());
        let mut epochs = self.epochs.borrow_mut();
        let epoch = &mut epochs[(number % 2) as usize];
        if epoch.number != number || epoch.views.is_empty() {
            *epoch = Epoch { number, views: self.permutation(number) };
        }
        epoch.views[place as usize]
    }

    fn permutation(&self, epoch: u32) -> Vec<usize> {
        let mut views = self.views.clone();
        views.shuffle(&mut random::generator(self.seed, Purpose::ViewOrder(self.phase), epoch));
        views
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whether or not steps look ahead or are repeated.
    #[test]
    fn every_epoch_is_a_permutation_of_its_own_that_is_made_once() {
        for (phase, n) in [(Phase::Warmup, 1), (Phase::Joint, 2), (Phase::Surface, 7)] {
            let views: Vec<usize> = (0..n).map(|i| 10 + 3 * i as usize).collect();
            let order = ViewOrder::new(views.clone(), 5, phase);
            let expected = |age: u32| {
                let mut views = views.clone();
                views.shuffle(&mut random::generator(5, Purpose::ViewOrder(phase), age / n));
                views[(age % n) as usize]
            };
            for age in 0..6 * n {
                let before = order.epochs.borrow()[(age / n % 2) as usize].views.as_ptr();
                for other in [age, age + n, age] {
                    assert_eq!(order.at(other), expected(other), "{phase:?}, {age}, {other}");
                }
                let after = order.epochs.borrow()[(age / n % 2) as usize].views.as_ptr();
                assert!(age == 0 || before == after, "{phase:?}, {age}");
                let again = age.saturating_sub(3 * n);
                assert_eq!(ViewOrder::new(views.clone(), 5, phase).at(again), expected(again));
            }
            // Back by several epochs, as where steps are repeated.
            for age in (0..6 * n).rev() {
                assert_eq!(order.at(age), expected(age), "{phase:?}, {age}");
            }
        }
    }
}
