//! Supported devices.

/// Vendors: 3Dconnexion since 2013, and Logitech, to whom it belonged before.
pub const VENDORS: [u16; 2] = [0x256f, 0x046d];

/// Usage page and usage of a multi-axis controller. A receiver has other interfaces beside it.
pub const MULTI_AXIS: (u16, u16) = (0x01, 0x08);

/// Product ids and names, as the public lists of USB ids and of spacenavd have them.
const PRODUCTS: [(u16, u16, &str); 23] = [
    (0x046d, 0xc603, "SpaceMouse Plus XT"),
    (0x046d, 0xc605, "CADman"),
    (0x046d, 0xc606, "SpaceMouse Classic"),
    (0x046d, 0xc621, "Spaceball 5000"),
    (0x046d, 0xc623, "SpaceTraveler"),
    (0x046d, 0xc625, "SpacePilot"),
    (0x046d, 0xc626, "SpaceNavigator"),
    (0x046d, 0xc627, "SpaceExplorer"),
    (0x046d, 0xc628, "SpaceNavigator for Notebooks"),
    (0x046d, 0xc629, "SpacePilot Pro"),
    (0x046d, 0xc62b, "SpaceMouse Pro"),
    (0x046d, 0xc640, "NuLOOQ"),
    (0x256f, 0xc62e, "SpaceMouse Wireless"),
    (0x256f, 0xc62f, "SpaceMouse Wireless"),
    (0x256f, 0xc631, "SpaceMouse Pro Wireless"),
    (0x256f, 0xc632, "SpaceMouse Pro Wireless"),
    (0x256f, 0xc633, "SpaceMouse Enterprise"),
    (0x256f, 0xc635, "SpaceMouse Compact"),
    (0x256f, 0xc636, "SpaceMouse Module"),
    (0x256f, 0xc638, "SpaceMouse Pro Wireless"),
    (0x256f, 0xc63a, "SpaceMouse Wireless"),
    (0x256f, 0xc652, "Universal Receiver"),
    (0x256f, 0xc658, "SpaceMouse Wireless"),
];

/// Name of the device with these ids, if it sends the messages of a 6-DOF mouse.
///
/// Logitech makes many other products, so only the listed ones count. A product of 3Dconnexion counts if it is a
/// multi-axis controller, listed or not; its ordinary mice do not. `usage` is page and usage of the interface,
/// where the system reports them.
pub fn known(vendor: u16, product: u16, usage: Option<(u16, u16)>) -> Option<&'static str> {
    if !VENDORS.contains(&vendor) || usage.is_some_and(|usage| usage != MULTI_AXIS) {
        return None;
    }
    let listed = PRODUCTS
        .iter()
        .find(|(v, p, _)| (*v, *p) == (vendor, product))
        .map(|(_, _, name)| *name);
    let new = (vendor == VENDORS[0] && usage.is_some()).then_some("6-DOF mouse");
    listed.or(new)
}
