//! Cuts at their due time.

use super::tests::*;
use super::*;

#[test]
fn cut_that_waits_at_the_join_goes_to_the_cut_worker() {
    let mut site = site(0);
    tell(&mut site, cut_of(hash_of_the_cut()), 50);
    let (mut prefetch, _view) = site.detach().unwrap();
    site.advance(ms(120)).unwrap();
    assert_eq!(site.replica().topology().version(), 0, "not made yet");
    prefetch.order(site.poll_cut_order().unwrap());
    site.handle_cut(prefetch.work().unwrap().unwrap());
    site.advance(ms(124)).unwrap();
    assert_eq!(site.replica().topology().version(), 1);
}

#[test]
fn only_changes_of_displayed_tools_hold_back_a_cut() {
    let delay = OperationKind::Compensation {
        delay_us: 12_000,
        effective_at: ServerTime::from_micros(5_300_000),
    };
    let note = OperationKind::AnnotationRemoved { id: 1 };
    let tool = OperationKind::Disconnected { participant: OTHER };
    for (before, version) in [(delay, 1), (note, 1), (tool, 0)] {
        let mut site = site(0);
        tell(&mut site, operation(0, 5200, before), 110);
        tell(&mut site, cut_of(hash_of_the_cut()), 111);
        site.advance(ms(120)).unwrap();
        assert_eq!(site.replica().topology().version(), version);
        site.advance(ms(220)).unwrap();
        assert_eq!(site.replica().topology().version(), 1);
    }
}
