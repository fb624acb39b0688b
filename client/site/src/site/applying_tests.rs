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
fn change_of_the_delay_holds_back_no_cut() {
    let mut site = site(0);
    let change = OperationKind::Compensation {
        delay_us: 12_000,
        effective_at: ServerTime::from_micros(5_300_000),
    };
    tell(&mut site, operation(0, 5200, change), 110);
    tell(&mut site, cut_of(hash_of_the_cut()), 111);
    site.advance(ms(120)).unwrap();
    assert_eq!(site.replica().topology().version(), 1);
}
