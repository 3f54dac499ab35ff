use std::net::IpAddr;

use super::request::Request;

/// The rules for the names under which the view answers and for the web pages that may read it.
///
/// A page of any web site can connect to a server on this computer, and can give that server a name
/// of its own (DNS rebinding). A browser sends the name under which it connects in the header
/// `Host`, and the site of the page that connects in `Origin`, so both are checked. For the images
/// and links of a page it sends no `Origin`, but says in `Sec-Fetch-Site` whether the page is of
/// another site. Programs without a browser's engine send neither `Origin` nor `Sec-Fetch-Site`.
#[derive(Clone, Debug, Default)]
pub(super) struct Admission {
    /// Name of this computer.
    pub(super) hostname: String,
    /// Origins that the operator has named.
    pub(super) origins: Vec<String>,
}

/// The reason why a request is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Refusal {
    /// The header `Host` is missing or repeated, or names neither an IP address nor this computer.
    Host,
    /// The page that connects is neither the view's own nor one that may read the view.
    Origin,
}

impl Admission {
    /// Checks the name under which a client connects and the web page, if any, that connects.
    pub(super) fn check(&self, request: &Request) -> Result<(), Refusal> {
        let host = request.header("host").ok_or(Refusal::Host)?;
        if !self.is_own(name_of(host)) {
            return Err(Refusal::Host);
        }
        if !request.has("origin") {
            let is_foreign = request.header("sec-fetch-site") == Some("cross-site");
            // A link to the view's own page may be anywhere, such as in an e-mail or a terminal in
            // the browser; following the link keeps no connection open.
            let is_link = request.header("sec-fetch-mode") == Some("navigate")
                && request.path == "/"
                && !request.is_upgrade();
            return if is_foreign && !is_link { Err(Refusal::Origin) } else { Ok(()) };
        }
        let origin = request.header("origin").ok_or(Refusal::Origin)?;
        let is_allowed = is_same(origin, host)
            || self.origins.iter().any(|allowed| allowed == origin)
            // Viewers on the operator's computer: pages of servers there, and programs whose origin
            // has a scheme of its own, which may only open a WebSocket. A web site has a host of
            // its own with `http` or `https`, and a page in a sandbox has the origin `null`.
            || match origin.split_once("://") {
                Some(("http" | "https", host)) => is_loopback(name_of(host)),
                Some(_) => request.is_upgrade(),
                None => false,
            };
        if is_allowed { Ok(()) } else { Err(Refusal::Origin) }
    }

    /// Returns whether a request comes from the view's own page or from a program that is no
    /// browser.
    pub(super) fn is_own_page(request: &Request) -> bool {
        match (request.has("origin"), request.header("origin"), request.header("host")) {
            (false, _, _) => true,
            (true, Some(origin), Some(host)) => is_same(origin, host),
            _ => false,
        }
    }

    /// Returns whether this is an address or a name of this computer: its host name, the first part
    /// of that, or the first part in the domain `local`. Other names in the domain name system are
    /// refused, because any site may give this computer's address a name.
    fn is_own(&self, name: &str) -> bool {
        let first = self.hostname.split('.').next().unwrap_or_default();
        let is_hostname = |own: &str| !own.is_empty() && name.eq_ignore_ascii_case(own);
        is_address(name)
            || is_loopback(name)
            || is_hostname(&self.hostname)
            || is_hostname(first)
            || !first.is_empty() && is_hostname(&format!("{first}.local"))
    }
}

fn is_same(origin: &str, host: &str) -> bool {
    origin.strip_prefix("http://").is_some_and(|of_page| of_page.eq_ignore_ascii_case(host))
}

/// The name in `name:port` or `[address]:port`.
fn name_of(host: &str) -> &str {
    if let Some(rest) = host.strip_prefix('[') {
        return rest.split(']').next().unwrap_or_default();
    }
    host.split(':').next().unwrap_or_default()
}

fn is_address(name: &str) -> bool {
    name.parse::<IpAddr>().is_ok()
}

fn is_loopback(name: &str) -> bool {
    name.eq_ignore_ascii_case("localhost")
        || name.parse::<IpAddr>().is_ok_and(|address| address.to_canonical().is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(host: &str, origin: Option<&str>, upgrade: bool) -> Result<(), Refusal> {
        let origin = origin.map(|origin| format!("Origin: {origin}\r\n")).unwrap_or_default();
        let upgrade = if upgrade { "Upgrade: websocket\r\n" } else { "" };
        let text = format!("GET / HTTP/1.1\r\nHost: {host}\r\n{origin}{upgrade}\r\n");
        let (request, length) = Request::parse(text.as_bytes()).unwrap().unwrap();
        assert_eq!(length, text.len());
        let origins = vec!["https://app.foxglove.dev".to_owned()];
        Admission { hostname: "bench".to_owned(), origins }.check(&request)
    }

    #[test]
    fn the_computers_own_names_are_answered_and_no_others() {
        for host in [
            "127.0.0.1:8765",
            "localhost:8765",
            "[::1]:8765",
            "192.168.1.7",
            "bench:80",
            "BENCH.local",
        ] {
            assert_eq!(check(host, None, false), Ok(()), "{host}");
        }
        for host in
            ["evil.example:8765", "localhost.evil.example", "bench.evil.example", "", ".local"]
        {
            assert_eq!(check(host, None, true), Err(Refusal::Host), "{host}");
        }
    }

    #[test]
    fn the_first_part_of_a_full_host_name_is_answered_too() {
        let hostname = "bench.cs.uni.example".to_owned();
        let admission = Admission { hostname, origins: Vec::new() };
        for (name, is_own) in [
            ("bench.cs.uni.example", true),
            ("Bench", true),
            ("bench.local", true),
            ("bench.evil.example", false),
            ("cs.uni.example", false),
            ("", false),
        ] {
            assert_eq!(admission.is_own(name), is_own, "{name}");
        }
    }

    #[test]
    fn pages_of_other_sites_are_refused() {
        let host = "127.0.0.1:8765";
        for origin in [
            "https://evil.example",
            "null",
            "http://localhost.evil.example",
            "http://evil.example:8765",
            "x",
        ] {
            for upgrade in [false, true] {
                assert_eq!(check(host, Some(origin), upgrade), Err(Refusal::Origin), "{origin}");
            }
        }
        for origin in ["http://127.0.0.1:8765", "http://localhost:8080", "https://app.foxglove.dev"]
        {
            assert_eq!(check(host, Some(origin), true), Ok(()), "{origin}");
        }
        assert_eq!(
            check(host, Some("file://"), true),
            Ok(()),
            "a viewer outside of the browser is refused"
        );
        assert_eq!(check(host, Some("file://"), false), Err(Refusal::Origin));
        assert_eq!(check("192.168.1.7:80", Some("http://192.168.1.7:80"), false), Ok(()));
        assert_eq!(
            check("192.168.1.7:80", Some("http://192.168.1.8:80"), false),
            Err(Refusal::Origin)
        );
    }

    #[test]
    fn images_of_other_sites_are_refused_and_links_to_the_page_are_not() {
        let asked = |path: &str, more: &str| {
            let text = format!("GET {path} HTTP/1.1\r\nHost: 127.0.0.1:8765\r\n{more}\r\n");
            let (request, _) = Request::parse(text.as_bytes()).unwrap().unwrap();
            Admission::default().check(&request)
        };
        let foreign = "Sec-Fetch-Site: cross-site\r\n";
        for path in ["/", "/events", "/live.js"] {
            assert_eq!(asked(path, ""), Ok(()), "a program, {path}");
            assert_eq!(asked(path, foreign), Err(Refusal::Origin), "{path}");
            for site in ["same-origin", "same-site", "none"] {
                assert_eq!(asked(path, &format!("Sec-Fetch-Site: {site}\r\n")), Ok(()), "{site}");
            }
        }
        let link = format!("{foreign}Sec-Fetch-Mode: navigate\r\n");
        assert_eq!(asked("/", &link), Ok(()));
        assert_eq!(asked("/events", &link), Err(Refusal::Origin));
        assert_eq!(
            asked("/", &format!("{link}Upgrade: websocket\r\n")),
            Err(Refusal::Origin),
            "a page follows a link by a WebSocket"
        );
        let allowed = format!("{foreign}Origin: http://localhost:8080\r\n");
        assert_eq!(
            asked("/events", &allowed),
            Ok(()),
            "a page of a server on this computer is refused"
        );
    }

    #[test]
    fn two_headers_of_one_name_count_as_none() {
        let text = "GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n";
        let (request, _) = Request::parse(text.as_bytes()).unwrap().unwrap();
        assert_eq!(Admission::default().check(&request), Err(Refusal::Host));
        let text =
            "POST /stop HTTP/1.1\r\nHost: h\r\nOrigin: http://h\r\nOrigin: http://evil\r\n\r\n";
        let (request, _) = Request::parse(text.as_bytes()).unwrap().unwrap();
        assert!(!Admission::is_own_page(&request));
    }
}
