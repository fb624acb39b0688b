//! The addresses under which participants reach the session, for programs and for browsers.

use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};

use palpate_protocol::link::CertificateHash;
use palpate_protocol::{Grant, JoinLink, Role};
use palpate_view::PageAddress;

use super::options::HostOptions;
use super::page_site::PageSite;

/// The parts of all addresses that are the same for every participant.
#[derive(Debug, Clone)]
pub(super) struct Links {
    host: String,
    /// Host name or address of the page.
    page_host: String,
    port: u16,
    certificate: CertificateHash,
}

impl Links {
    /// The links of a server that listens on an address.
    pub(super) fn new(
        options: &HostOptions,
        address: SocketAddr,
        certificate: CertificateHash,
        site: Option<&PageSite>,
    ) -> Self {
        Self {
            host: public_host(options.public.as_deref(), address),
            page_host: site.map(|site| site.host.clone()).unwrap_or_default(),
            port: address.port(),
            certificate,
        }
    }

    /// The join link of a grant.
    pub(super) fn link(&self, role: Role, grant: Grant) -> JoinLink {
        JoinLink {
            host: self.host.clone(),
            port: self.port,
            role,
            certificate: self.certificate,
            grant,
        }
    }

    /// The address of the page for a grant. A name fills in the form of the page.
    pub(super) fn page(
        &self,
        page: PageAddress,
        role: Role,
        grant: Grant,
        name: Option<&str>,
    ) -> String {
        let mut fragment = format!("role={role}&grant={}", grant.token());
        if let Some(name) = name {
            fragment += "&name=";
            fragment += &escaped(name);
        }
        page.url_of(&self.page_host, &fragment)
    }
}

/// A text as a value in a fragment (RFC 3986, 2.1).
fn escaped(text: &str) -> String {
    text.bytes()
        .map(|byte| {
            if byte.is_ascii_alphanumeric() {
                char::from(byte).to_string()
            } else {
                format!("%{byte:02X}")
            }
        })
        .collect()
}

/// Host name for links: option `--public`, the address it listens on, or the address of the default route.
pub(super) fn public_host(public: Option<&str>, address: SocketAddr) -> String {
    if let Some(host) = public {
        return host.to_owned();
    }
    if !address.ip().is_unspecified() {
        return address.ip().to_string();
    }
    // Connecting a UDP socket only selects the interface and sends nothing. The address is reserved for documentation
    // (RFC 5737).
    let chosen = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))
        .and_then(|s| {
            s.connect((Ipv4Addr::new(192, 0, 2, 1), 9))
                .and_then(|()| s.local_addr())
        })
        .map(|a| a.ip());
    chosen
        .unwrap_or(IpAddr::V4(Ipv4Addr::LOCALHOST))
        .to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn link_and_page_carry_role_and_grant_and_any_name_stays_one_value() {
        let links = Links {
            host: "h.example".to_owned(),
            page_host: "h.example".to_owned(),
            port: 4433,
            certificate: CertificateHash([0xa5; 32]),
        };
        let grant = Grant([7; 16]);
        let link = links.link(Role::Trainee, grant);
        assert_eq!(link.to_string().parse(), Ok(link));
        let page = PageAddress {
            socket: SocketAddr::from(([0, 0, 0, 0], 80)),
            is_https: true,
        };
        let url = |name| links.page(page, Role::Trainee, grant, name);
        let plain = format!("https://h.example:80/#role=trainee&grant={}", grant.token());
        assert_eq!(url(None), plain);
        let named = url(Some("Bö & role=instructor"));
        assert_eq!(
            named,
            format!("{plain}&name=B%C3%B6%20%26%20role%3Dinstructor")
        );
    }
}
