// May the hand lift? Client of a graspd daemon: its newest verdict, or `unknown` without one.
//
// One header to copy: C++17, Linux, cppzmq and nlohmann-json (apt install cppzmq-dev
// nlohmann-json3-dev, link with -lzmq). The messages are those of deploy/wire/README.md, version 1;
// the rules are those of ../python/graspd_client.py, step by step.
//
//     graspd::Client client(options);  // with an endpoint and an ask_endpoint
//     if (const auto answer = client.may_i_lift(0.5))
//         client.tell(answer.verdict, lift() ? graspd::Outcome::held : graspd::Outcome::slipped);
//
// Only ZeroMQ's own thread runs in the background. Use an object only in the thread that made it.
// Only `verdict(wait_s)`, `may_i_lift(deadline_s)`, `wait_for_grasp(deadline_s)`,
// `wait_for_slide(timeout_s)` and `tell(..., wait_s)` wait, at most for the given time, and the
// destructor, for up to 0.2 s.
#pragma once

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstdint>
#include <ctime>
#include <deque>
#include <fstream>
#include <functional>
#include <iostream>
#include <iterator>
#include <map>
#include <memory>
#include <optional>
#include <random>
#include <set>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <unistd.h>

#include <nlohmann/json.hpp>
#include <zmq_addon.hpp>

namespace graspd {

using Nanoseconds = std::int64_t;

constexpr std::int64_t VERSION = 1;  // version of the messages; others are refused
constexpr std::uint64_t INTEGER_MAX = std::uint64_t{1} << 60;  // as a time, 36 years in ns
constexpr double REAL_MAX = 1e12;                              // as a time, thirty years in ms
constexpr double WAIT_MAX_S = 1e9;                             // of a call: thirty years
// A verdict has 0.7 kB, at most 3; a peer that sends more is not a daemon and is disconnected.
constexpr std::size_t MESSAGE_MAX_BYTES = 1 << 16;
// Most lists and objects in a message, and so its greatest depth; a verdict has ten.
constexpr std::ptrdiff_t OPENINGS_MAX = 100;
constexpr int QUEUE_MAX = 1000;  // messages that wait to be read: ten seconds at 100 Hz
// A client that has not read for longer reconnects, because its queue is old and full.
constexpr Nanoseconds READ_WITHIN_NS = 5'000'000'000;
// Shortest and longest time without a message after which a client reconnects. libzmq does not
// retry after a refusal, but the daemon may admit the client by then.
constexpr Nanoseconds QUIET_NS = 1'000'000'000, QUIET_MAX_NS = 10'000'000'000;
// The computer has slept if its two clocks differ by more. A sleep takes seconds, the
// scheduler a moment between two looks at the clocks.
constexpr Nanoseconds SLEPT_NS = 50'000'000;
// Longest wait in one piece, and so the error of the time when another computer's message came.
constexpr std::int64_t SLICE_MS = 10;
// Most by which a message's time may be in the future while the clocks count as the same.
constexpr Nanoseconds CLOCK_SLACK_NS = 1'000'000;
// Largest drift between two computers' clocks: NTP slews by 5e-4, a bad crystal is off by 1e-4.
constexpr double DRIFT = 1e-3;
// Largest total drift while the daemon's clock is not known; beyond it verdicts are unknown. A
// delay that grows as slowly looks the same.
constexpr Nanoseconds DRIFT_MAX_NS = 20'000'000;
// Time between two questions for the daemon's clock, and after one that was not answered.
constexpr Nanoseconds CLOCK_EVERY_NS = 1'000'000'000, CLOCK_RETRY_NS = 10'000'000'000;
constexpr std::size_t FORMER_MAX = 16;  // ended starts of the daemon that are remembered
// On TCP: time between two heartbeats, and time without one until reconnecting.
constexpr int HEARTBEAT_MS = 1000, HEARTBEAT_TIMEOUT_MS = 3000;
constexpr std::size_t OBJECT_MAX = 64;  // characters of an object's name
constexpr std::size_t NAME_BYTES = 16;   // of a client's name
constexpr std::size_t LIFTS_MAX = 256;  // lifts that are remembered, as in graspd
constexpr std::int64_t WARN_EVERY = 10;  // unreported lifts for each warning
// Longest wait in the destructor until graspd has received that no lift follows, and most
// connections that say so at a time.
constexpr int TAKE_BACK_MS = 200;
constexpr std::size_t LEAVING_MAX = 4;

// graspd's decision about a grasp; the numbers are those of `verdict_code`.
enum class Decision { unknown = 0, stable = 1, slip = 2 };

// The word for a decision in messages.
inline const char* name(Decision decision) {
    constexpr const char* names[] = {"unknown", "stable", "slip"};
    return names[static_cast<int>(decision)];
}

// State of a finger.
enum class FingerState { free, touch, slide };

// The word for a finger's state in messages.
inline const char* name(FingerState state) {
    constexpr const char* names[] = {"free", "touch", "slide"};
    return names[static_cast<int>(state)];
}

// How a lift ended.
enum class Outcome { held, slipped, not_lifted };

// Outcomes of `stable` lifts: number of `lifts` with a known outcome, and of `slips` among them.
struct Risk {
    std::optional<double> target;  // share of slips that is allowed; none: no risk is set
    std::int64_t lifts = 0, slips = 0;
    std::int64_t outstanding = 0;  // outcomes that can still come
    std::optional<double> bound;   // upper bound of `slips`; each outstanding lift may add one
    std::int64_t warm_up_left = 0;  // outcomes until most grasps need no supervision
    std::int64_t announced = 0;     // grasps answered `stable` to `lift`, less those taken back
    std::int64_t awaited = 0;  // announced lifts without an outcome; too many forbid `stable`
};

// Verdict on the grasp. True in an `if` exactly when it is stable; then no person need watch.
struct Verdict {
    Decision decision = Decision::unknown;
    // Why it is unknown: the daemon's reasons, or one of those in deploy/clients/README.md.
    std::vector<std::string> reasons;
    std::optional<double> p_slip;        // probability of slip; none when unknown
    std::optional<std::int64_t> grasp;   // number of the contact episode
    std::optional<std::int64_t> seq;     // number of the message since the daemon's start
    std::string boot_id;                 // names that start; empty before the first message
    // Time since the reading's last byte; from another computer estimated.
    std::optional<double> age_ms;
    std::optional<double> p_slip_model;  // `p_slip` by the model alone
    std::int64_t outcomes = 0;           // number of outcomes that `p_slip` rests on
    bool supervised = false;             // graspd would learn from the lift; a person must watch
    std::optional<Risk> risk;            // none if graspd neither learns nor has a `[risk]`
    // Judged when nothing moved fast, but something might still slide slowly.
    bool early = false;
    // For how long the hand has been still: from 100 on nothing moves fast, from 240 on nothing
    // slides slowly either; none if the daemon does not say.
    std::optional<double> still_ms;
    // Motion of each finger, in units of its own noise, none if not known; and the largest motion
    // that counts as still.
    std::map<std::string, std::optional<double>> motion;
    std::map<std::string, double> motion_limits;
    // State of each finger; none if not known, and always if the reading is older than
    // `max_age_ms`.
    std::map<std::string, std::optional<FingerState>> fingers;
    // `you` if you report the outcome of the lift, `another` if another controller does, which may
    // be lifting; empty if the daemon does not say.
    std::string owner;

    explicit operator bool() const { return decision == Decision::stable && !supervised; }

    // Returns the same verdict as unknown for these reasons, which forbids a lift.
    Verdict unknown(std::vector<std::string> why) const {
        Verdict same = *this;
        same.decision = Decision::unknown;
        same.reasons = std::move(why);
        same.p_slip = same.p_slip_model = std::nullopt;
        same.supervised = false;
        return same;
    }
};

// Whether to lift. True in an `if` exactly when the hand may.
struct LiftAnswer {
    Verdict verdict;  // that decided; its reasons may also be `no-answer`, `late`, `not-still`
    double waited_s = 0.0;
    // True if the hand may lift only while a person watches; only if asked with `supervised`.
    bool supervised = false;

    explicit operator bool() const { return static_cast<bool>(verdict) || supervised; }
};

// Result of watching a lift by its fingers. True in an `if` when the lift must be stopped.
struct SlideAnswer {
    Verdict verdict;  // the newest; its `fingers` and `reasons` say what is known
    double waited_s = 0.0;
    std::vector<std::string> sliding = {};  // fingers along which something slides
    // True if fingers touched, all of them until the timeout, and nothing slid.
    bool held = false;

    explicit operator bool() const { return !held; }
};

// Answer to a reported outcome. True in an `if` exactly when graspd has accepted it.
struct OutcomeAnswer {
    // Why it was not accepted: the daemon's text, or `no-answer`, `malformed`, `version` or
    // `other-process`.
    std::string why;

    explicit operator bool() const { return why.empty(); }
};

// Numbers of messages since the client was made.
struct Counts {
    std::int64_t messages = 0;   // new messages of this hand
    std::uint64_t lost = 0;      // messages missing by gaps in `seq`
    std::int64_t repeats = 0;    // messages that were known already
    std::int64_t malformed = 0;  // messages and answers that are not understood
    std::int64_t restarts = 0;   // times that the daemon was started again
    std::int64_t former = 0;     // messages of an earlier start of the daemon
};

// CURVE keys, Z85: the daemon's public key, and the client's own pair.
struct Keys {
    std::string server_key, public_key, secret_key;

    // Returns the keys in the daemon's `.key` and the client's `.key_secret` file (`graspd keys`).
    // Throws `std::runtime_error`.
    static Keys load(const std::string& server, const std::string& own) {
        return {value(server, "public-key"), value(own, "public-key"), value(own, "secret-key")};
    }

private:
    static std::string value(const std::string& path, const std::string& which) {
        std::ifstream file(path);
        for (std::string line; std::getline(file, line);) {
            const auto at = line.find(which + " = \"");
            const auto from = line.find('"') + 1;
            const auto to = line.rfind('"');
            if (at != std::string::npos && to > from) return line.substr(from, to - from);
        }
        throw std::runtime_error(path + ": no " + which);
    }
};

struct Options {
    std::string endpoint;
    std::string hand = "right";
    double max_age_ms = 100.0;  // largest age of a reading that permits a lift
    // `[ask]`: socket at which `may_i_lift` asks for a judgement and `tell` reports.
    std::string ask_endpoint = {};
    // True if the daemon's monotonic clock is also the client's. Empty: true for ipc:// and
    // loopback addresses, so pass false for a tunnel.
    std::optional<bool> same_computer = {};
    std::optional<Keys> keys = {};
    // A `stable` with this `p_slip` or more counts as unknown. Pass the scene's `slip_threshold` if
    // it is above 0.5.
    double max_p_slip = 0.5;
    // Called with a warning at the first lift whose outcome was not reported, and every ten later.
    std::function<void(const std::string&)> warn = [](const std::string& text) {
        std::cerr << "graspd_client: " << text << '\n';
    };
};

namespace detail {

using nlohmann::json;

inline Nanoseconds now_ns(clockid_t clock = CLOCK_MONOTONIC) {
    timespec now{};
    clock_gettime(clock, &now);
    return static_cast<Nanoseconds>(now.tv_sec) * 1'000'000'000 + now.tv_nsec;
}

// Returns how long the computer has slept, plus a constant, ns: the difference of two clocks.
inline Nanoseconds slept_ns() {
    const Nanoseconds awake_and_asleep_ns = now_ns(CLOCK_BOOTTIME);
    return awake_and_asleep_ns - now_ns();
}

inline bool is_same_computer(std::string_view endpoint) {
    for (const std::string_view local : {"ipc://", "tcp://127.", "tcp://[::1]", "tcp://localhost:"})
        if (endpoint.substr(0, local.size()) == local) return true;
    return false;
}

using Key = std::pair<std::string, std::int64_t>;  // names a grasp

inline Key key(const Verdict& said) { return {said.boot_id, said.grasp.value_or(0)}; }

// Used fields of a verdict message.
struct Message {
    Verdict verdict;               // without its age
    Nanoseconds read_ns = 0;       // by the daemon's clock: when the reading's last byte came ...
    Nanoseconds published_ns = 0;  // ... and when the message went out
    Nanoseconds silence_ns = 0;
};

struct Malformed {};

inline const json& field(const json& told, const std::string& name) {
    const auto found = told.find(name);
    if (found == told.end()) throw Malformed{};
    return *found;
}

inline std::int64_t integer(const json& told, const std::string& name) {
    const json& value = field(told, name);
    if (!value.is_number_integer()) throw Malformed{};
    if (value.is_number_unsigned() && value.get<std::uint64_t>() > INTEGER_MAX) throw Malformed{};
    const auto number = value.get<std::int64_t>();
    if (number < 0) throw Malformed{};
    return number;
}

inline double number(const json& told, const std::string& name, double most) {
    const json& value = field(told, name);
    if (!value.is_number()) throw Malformed{};
    const auto number = value.get<double>();
    if (!(number >= 0.0 && number <= most)) throw Malformed{};
    return number;
}

inline Nanoseconds milliseconds(const json& told, const std::string& name) {
    return std::llrint(number(told, name, REAL_MAX) * 1e6);
}

inline std::optional<double> maybe(const json& told, const std::string& name, double most) {
    if (field(told, name).is_null()) return std::nullopt;
    return number(told, name, most);
}

inline std::string text(const json& value) {
    if (!value.is_string()) throw Malformed{};
    return value.get<std::string>();
}

inline Risk risk(const json& told) {
    if (!told.is_object()) throw Malformed{};
    Risk found{maybe(told, "target", 1.0), integer(told, "lifts"), integer(told, "slips"),
               integer(told, "outstanding"), maybe(told, "bound", REAL_MAX),
               integer(told, "warm_up_left")};
    // Older daemons leave these out.
    if (told.contains("announced")) found.announced = integer(told, "announced");
    if (told.contains("awaited")) found.awaited = integer(told, "awaited");
    if (found.slips > found.lifts) throw Malformed{};
    return found;
}

// Reads `p_slip_model`, `outcomes`, `risk`, `supervised`, which daemons without learning leave out.
inline void trust(const json& told, Verdict& found) {
    if (told.contains("p_slip_model")) found.p_slip_model = maybe(told, "p_slip_model", 1.0);
    if (found.p_slip_model && !found.p_slip) throw Malformed{};
    if (told.contains("outcomes")) found.outcomes = integer(told, "outcomes");
    const auto risked = told.find("risk");
    if (risked != told.end() && !risked->is_null()) found.risk = risk(*risked);
    const auto watched = told.find("supervised");
    if (watched == told.end()) return;
    if (!watched->is_boolean()) throw Malformed{};
    // An unknown grasp is supervised only if nothing but [risk] is against it.
    found.supervised = watched->get<bool>() &&
        std::all_of(found.reasons.begin(), found.reasons.end(), [](const std::string& reason) {
            return reason == "unproven" || reason == "low-confidence";
        });
}

// Returns the state of a finger; none if not known.
inline std::optional<FingerState> finger_state(const json& told) {
    if (told.is_null()) return std::nullopt;
    const std::string word = text(told);
    for (const auto state : {FingerState::free, FingerState::touch, FingerState::slide})
        if (word == name(state)) return state;
    throw Malformed{};
}

// Returns the fingers in this state.
inline std::vector<std::string> feeling(const Verdict& said, FingerState state) {
    std::vector<std::string> found;
    for (const auto& [finger, felt] : said.fingers)
        if (felt == state) found.push_back(finger);
    return found;
}

// Reads the fields that daemons without stillness leave out: `early` to `owner` of a verdict.
inline void stillness(const json& told, Verdict& found) {
    const auto early = told.find("early");
    if (early != told.end()) {
        if (!early->is_boolean()) throw Malformed{};
        found.early = early->get<bool>();
    }
    const auto owner = told.find("owner");
    if (owner != told.end() && !owner->is_null()) found.owner = text(*owner);
    if (told.contains("still_ms")) found.still_ms = maybe(told, "still_ms", REAL_MAX);
    const json nothing = json::object();
    const auto by_finger = [&](const char* which) -> const json& {
        const auto moves = told.find(which);
        if (moves == told.end() || moves->is_null()) return nothing;
        if (!moves->is_object()) throw Malformed{};
        return *moves;
    };
    const json &motion = by_finger("motion"), &limits = by_finger("motion_limits");
    const json& felt = by_finger("fingers");
    for (const auto& each : felt.items()) found.fingers[each.key()] = finger_state(each.value());
    for (const auto& each : motion.items())
        found.motion[each.key()] = maybe(motion, each.key(), REAL_MAX);
    for (const auto& each : limits.items())
        found.motion_limits[each.key()] = number(limits, each.key(), REAL_MAX);
}

inline Message message(const json& told) {
    Message all;
    Verdict& found = all.verdict;
    const auto code = integer(told, "verdict_code");
    if (code > 2 || text(field(told, "verdict")) != name(static_cast<Decision>(code)))
        throw Malformed{};
    found.decision = static_cast<Decision>(code);
    const bool known = found.decision != Decision::unknown;
    const json& valid = field(told, "valid");
    if (!valid.is_boolean() || valid.get<bool>() != known) throw Malformed{};
    found.p_slip = maybe(told, "p_slip", 1.0);
    if (found.p_slip.has_value() != known) throw Malformed{};
    const json& reasons = field(told, "reasons");
    if (!reasons.is_array() || reasons.empty() != known) throw Malformed{};
    for (const json& reason : reasons) found.reasons.push_back(text(reason));
    found.boot_id = text(field(told, "boot_id"));
    found.seq = integer(told, "seq");
    found.grasp = integer(told, "grasp");
    trust(told, found);
    stillness(told, found);
    all.read_ns = integer(told, "t_mono_ns");
    all.published_ns = all.read_ns + milliseconds(told, "age_ms");
    all.silence_ns = milliseconds(told, "silence_ms");
    return all;
}

// Returns the JSON object in a payload. For any other, too long or deep, or with a repeated key, on
// which readers disagree, returns a value that is not an object.
inline json parsed(std::string_view payload) {
    const auto opens = [](char c) { return c == '[' || c == '{'; };
    // A byte order mark is passed over by the parser, and a NUL is its end.
    if (payload.empty() || payload.front() == '\xEF' ||
        payload.find('\0') != std::string_view::npos || payload.size() > MESSAGE_MAX_BYTES ||
        std::count_if(payload.begin(), payload.end(), opens) > OPENINGS_MAX)
        return nullptr;
    std::vector<std::set<std::string>> keys;  // of the objects that are open
    bool twice = false;
    const auto note = [&](int, json::parse_event_t event, json& value) {
        if (event == json::parse_event_t::object_start) keys.emplace_back();
        if (event == json::parse_event_t::object_end) keys.pop_back();
        if (event == json::parse_event_t::key)
            twice |= !keys.back().insert(value.get<std::string>()).second;
        return true;
    };
    json told = json::parse(payload, note, false);
    return twice ? json() : told;
}

// Returns a verdict message, or why it is not one: `malformed` or `version`.
inline std::pair<std::optional<Message>, std::string> read(std::string_view payload,
                                                           double max_p_slip) {
    const json told = parsed(payload);
    if (!told.is_object()) return {std::nullopt, "malformed"};
    try {
        if (integer(told, "v") != VERSION) return {std::nullopt, "version"};
        Message found = message(told);
        Verdict& said = found.verdict;
        // A `stable` with too high a `p_slip` is unknown.
        if (said.decision == Decision::stable && *said.p_slip >= max_p_slip)
            said = said.unknown({"p-slip"});
        return {std::move(found), ""};
    } catch (const Malformed&) {
        return {std::nullopt, "malformed"};
    }
}

// Throws `std::invalid_argument` for a text that is not an object's name; an empty one is allowed.
inline void check_object(const std::string& name) {
    const auto fits = [&name](const char& c) {
        const bool plain = (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') ||
                           (c >= '0' && c <= '9') || c == '_';
        return plain || (&c != name.data() && (c == '-' || c == '.'));
    };
    if (name.size() > OBJECT_MAX || !std::all_of(name.begin(), name.end(), fits))
        throw std::invalid_argument("no name of an object: 1 to 64 ASCII letters, digits, _, -, ., "
                                    "the first no - and no .: " + name);
}

// Returns the message that reports an outcome. Throws `std::invalid_argument` without a grasp, or
// for a wrong name.
inline std::string telling(const Verdict& lifted_on, Outcome how, const std::string& object_name) {
    if (lifted_on.boot_id.empty() || lifted_on.grasp.value_or(0) == 0)
        throw std::invalid_argument("nothing was lifted on a verdict that is of no grasp");
    const auto told = "outcome " + lifted_on.boot_id + ' ' + std::to_string(*lifted_on.grasp) +
                      (how == Outcome::held      ? " stable"
                       : how == Outcome::slipped ? " slip"
                                                 : " not-lifted");
    check_object(object_name);
    return object_name.empty() ? told : told + ' ' + object_name;
}

// Returns the answer to an outcome; none if it is not understood.
inline std::optional<OutcomeAnswer> taken(std::string_view payload) {
    const json told = parsed(payload);
    if (!told.is_object()) return std::nullopt;
    try {
        if (integer(told, "v") != VERSION) return OutcomeAnswer{"version"};
        const json& ok = field(told, "ok");
        if (!ok.is_boolean()) return std::nullopt;
        const std::string why = ok.get<bool>() ? "" : text(field(told, "why"));
        if (why.empty() != ok.get<bool>()) return std::nullopt;
        return OutcomeAnswer{why};
    } catch (const Malformed&) {
        return std::nullopt;
    }
}

// Returns the daemon's clock, ns; none if the answer is not understood.
inline std::optional<Nanoseconds> told_clock(std::string_view payload) {
    const json told = parsed(payload);
    if (!told.is_object()) return std::nullopt;
    try {
        if (integer(told, "v") != VERSION) return std::nullopt;
        return integer(told, "t_mono_ns");
    } catch (const Malformed&) {
        return std::nullopt;
    }
}

// State of a hand by its newest message; it has neither socket nor clock.
class Newest {
public:
    Newest(std::string topic, Nanoseconds max_age_ns, bool same_computer, double max_p_slip = 0.5)
        : topic_(std::move(topic)), max_age_ns_(max_age_ns), same_computer_(same_computer),
          max_p_slip_(max_p_slip) {}

    // Each finger with each state that it had in the messages of the last look.
    std::set<std::pair<std::string, FingerState>> passed;
    Counts counts;
    bool may_be_announced = false;  // whether the last answer may have announced a lift

    // Longest silence before the grasp is unknown, ns; 0 without a message.
    Nanoseconds silence_ns() const { return message_ ? message_->silence_ns : 0; }

    // Forget the message and the clocks' difference; still recognise repeats. `why`: reason to give
    // until the next message.
    void forget(std::string why) {
        message_.reset();
        best_.reset();
        bound_.reset();
        why_ = std::move(why);
    }

    // Note that the daemon's clock read `told_ns` at some time after `asked_ns` (own clock).
    void compare_clocks(Nanoseconds asked_ns, Nanoseconds told_ns) {
        Nanoseconds least_ns = asked_ns - told_ns;
        if (bound_) least_ns = std::max(least_ns, at_least(*bound_, asked_ns));
        bound_ = {least_ns, asked_ns};
    }

    // Take in a message that arrived after `empty_ns` and by `now_ns` (own clock). Returns true for
    // a new one, understood or not; false for a repeat, or one of another hand or of an earlier
    // start of the daemon.
    bool take(const std::vector<std::string_view>& frames, Nanoseconds empty_ns,
              Nanoseconds now_ns) {
        if (frames.empty() || frames[0] != topic_) return false;
        auto [found, why] = frames.size() == 2
            ? read(frames[1], max_p_slip_) : std::pair(std::optional<Message>{}, std::string("malformed"));
        if (!found) {
            ++counts.malformed;
            message_.reset();
            why_ = why;
            return true;
        }
        if (!is_new(*found)) return false;
        ++counts.messages;
        published_ns_ = same_computer_ ? found->published_ns
                                       : by_arrival(found->published_ns, empty_ns, now_ns);
        for (const auto& [finger, felt] : found->verdict.fingers)
            if (felt) passed.emplace(finger, *felt);
        message_ = std::move(found);
        return true;
    }

    // Returns the verdict that holds at `now_ns` (own clock).
    Verdict at(Nanoseconds now_ns) const {
        if (!message_) return Verdict{}.unknown({why_});
        const Nanoseconds age_ns = published_ns_ ? now_ns - *published_ns_ : 0;
        const Nanoseconds reading_age_ns = age_ns + message_->published_ns - message_->read_ns;
        Verdict said = message_->verdict;
        said.age_ms = static_cast<double>(reading_age_ns) / 1e6;
        const bool counts_on_it = said.decision != Decision::unknown || said.supervised;
        const bool may_have_crept = !bound_ && best_ && best_->first - least_ns_ > DRIFT_MAX_NS;
        const bool is_clock_known = age_ns >= -CLOCK_SLACK_NS && !may_have_crept;
        const bool is_fresh = age_ns <= message_->silence_ns && reading_age_ns <= max_age_ns_;
        // An old reading does not show the fingers' present state.
        if (!published_ns_ || !is_clock_known || !is_fresh)
            for (auto& [finger, felt] : said.fingers) felt.reset();
        if (!published_ns_) return said.unknown({"joining"});
        if (!is_clock_known) return said.unknown({"clock"});
        if (age_ns > message_->silence_ns) return said.unknown({"silent"});
        if (counts_on_it && reading_age_ns > max_age_ns_) return said.unknown({"stale"});
        return if_open(std::move(said));
    }

    // Note that the outcome of a grasp was reported, so it must not be lifted again.
    void end(const Key& grasp) {
        ended_.erase(std::remove(ended_.begin(), ended_.end(), grasp), ended_.end());
        ended_.push_back(grasp);
        if (ended_.size() > LIFTS_MAX) ended_.pop_front();
    }

    // Parses an answer to `lift`, and sets `may_be_announced`; none if not understood. A verdict on
    // a grasp whose outcome was reported becomes unknown.
    std::optional<Verdict> answered(std::string_view payload) {
        auto found = read(payload, max_p_slip_).first;
        may_be_announced = !found || found->verdict.decision == Decision::stable ||
                           found->verdict.reasons == std::vector<std::string>{"p-slip"};
        if (found) return if_open(found->verdict);
        ++counts.malformed;
        return std::nullopt;
    }

private:
    // Returns the verdict, as unknown if the outcome of its grasp was reported.
    Verdict if_open(Verdict said) const {
        const bool is_offered = said.decision != Decision::unknown || said.supervised;
        const bool ended = std::find(ended_.begin(), ended_.end(), key(said)) != ended_.end();
        return is_offered && ended ? said.unknown({"outcome-told"}) : said;
    }

    bool is_former(const std::string& boot_id) const {
        return std::find(former_.begin(), former_.end(), boot_id) != former_.end();
    }

    // Returns true if a message of another start was sent before the known one; always false if the
    // daemon has another clock.
    bool is_older(const Message& message) const {
        return same_computer_ && published_ns_ && message.published_ns < *published_ns_;
    }

    bool is_new(const Message& message) {
        const Verdict& found = message.verdict;
        if (boot_id_ != found.boot_id) {
            if (is_former(found.boot_id) || is_older(message)) return ++counts.former, false;
            if (boot_id_) {
                former_.push_back(*boot_id_);
                if (former_.size() > FORMER_MAX) former_.pop_front();
                ++counts.restarts;
                best_.reset();
                bound_.reset();
            }
            boot_id_ = found.boot_id;
            seq_ = *found.seq;
            return true;
        }
        if (*found.seq <= seq_) return ++counts.repeats, false;
        counts.lost += static_cast<std::uint64_t>(*found.seq - seq_ - 1);
        seq_ = *found.seq;
        return true;
    }

    // Returns the least difference of own and daemon's clock at `now_ns`, ns: that of `bound`
    // (difference, its time) less the drift since.
    static Nanoseconds at_least(const std::pair<Nanoseconds, Nanoseconds>& bound,
                                Nanoseconds now_ns) {
        return bound.first - std::llrint(static_cast<double>(now_ns - bound.second) * DRIFT);
    }

    // Returns when a message was sent (own clock): after a clock comparison the earliest possible
    // time, else as if the fastest message took no time. None for the first one, which may have
    // been kept for late subscribers. `empty_ns`: as in `take`.
    std::optional<Nanoseconds> by_arrival(Nanoseconds published_ns, Nanoseconds empty_ns,
                                          Nanoseconds now_ns) {
        if (bound_)  // the bound holds however long it waited here
            return std::min(published_ns + at_least(*bound_, now_ns), now_ns);
        const std::pair here{now_ns - published_ns, now_ns};
        if (!best_) {
            best_ = here;
            least_ns_ = here.first;
            return std::nullopt;
        }
        const auto [best_ns, at_ns] = *best_;
        const Nanoseconds late_ns =
            here.first - best_ns - std::llrint(static_cast<double>(now_ns - at_ns) * DRIFT);
        if (late_ns <= 0) {
            best_ = here;
            least_ns_ = std::min(least_ns_, here.first);
        }
        return std::min(empty_ns, now_ns - std::max<Nanoseconds>(late_ns, 0));
    }

    std::string topic_;
    Nanoseconds max_age_ns_;
    bool same_computer_;
    double max_p_slip_;
    std::optional<Message> message_;
    std::optional<Nanoseconds> published_ns_;  // publication or an estimate, own clock
    std::string why_ = "no-message";
    std::optional<std::string> boot_id_;
    std::int64_t seq_ = -1;
    std::deque<std::string> former_;
    std::deque<Key> ended_;  // grasps whose outcome was reported, the oldest first
    // Smallest difference of arrival and publication, given the drift since, and its time, ns.
    std::optional<std::pair<Nanoseconds, Nanoseconds>> best_;
    Nanoseconds least_ns_ = 0;  // smallest of these differences ever, whatever the drift
    // Lower bound of the clocks' difference by the daemon's answer, and its time, ns.
    std::optional<std::pair<Nanoseconds, Nanoseconds>> bound_;
};

// Returns the result of a ZeroMQ call, which is repeated if a signal interrupts it.
template <typename Call>
auto uninterrupted(const Call& call) {
    while (true) {
        try {
            return call();
        } catch (const zmq::error_t& error) {
            if (error.num() != EINTR) throw;
        }
    }
}

// Receives the next message into `frames`; false if none waits.
inline bool received(zmq::socket_t& socket, std::vector<zmq::message_t>& frames) {
    frames.clear();
    do {
        zmq::message_t frame;
        if (!uninterrupted([&] { return socket.recv(frame, zmq::recv_flags::dontwait); }))
            return false;
        frames.push_back(std::move(frame));
    } while (frames.back().more());
    return true;
}

// Requests of one kind to the daemon, one at a time, on a socket of their own.
struct Call {
    zmq::socket_t socket;

    // Returns the answer; none if none has come yet, empty if it is not a single frame.
    std::optional<std::string> answer() {
        std::vector<zmq::message_t> frames;
        if (!socket || !received(socket, frames)) return std::nullopt;
        return frames.size() == 1 ? frames[0].to_string() : std::string();
    }

    // Close the socket, so that a late answer is not mistaken for one to the next question.
    void hang_up() {
        socket.close();
        socket = zmq::socket_t();
    }
};

// The sockets of a client.
class Link {
public:
    explicit Link(const Options& options)
        : options_(options), socket_(connected(zmq::socket_type::sub, options.endpoint)) {
        if (!options.ask_endpoint.empty())  // at once, to refuse a wrong endpoint
            asking.socket = connected(zmq::socket_type::dealer, options.ask_endpoint);
    }

    bool receive(std::vector<zmq::message_t>& frames) { return received(socket_, frames); }

    // Waits for a message or an answer, at most `timeout_ms`; a signal ends it sooner.
    void wait(std::int64_t timeout_ms) {
        std::vector<zmq_pollitem_t> items;
        for (zmq::socket_t* each : {&socket_, &asking.socket, &telling.socket})
            if (*each) items.push_back({each->handle(), 0, ZMQ_POLLIN, 0});
        zmq_poll(items.data(), static_cast<int>(items.size()), static_cast<long>(timeout_ms));
    }

    // Send a question; returns false if it is lost, as the peer has turned this client away.
    bool ask(Call& call, const std::string& question) {
        if (!call.socket)
            call.socket = connected(zmq::socket_type::dealer, options_.ask_endpoint);
        const auto sent = uninterrupted(
            [&] { return call.socket.send(zmq::buffer(question), zmq::send_flags::dontwait); });
        if (!sent) call.hang_up();  // libzmq makes no other connection
        return sent.has_value();
    }

    // Report that no lift follows the question. Its socket stays open, so that this is sent; beyond
    // `LEAVING_MAX` the oldest closes, even if its message was not sent.
    void take_back(Call& call) {
        if (!call.socket) return;
        call.socket.set(zmq::sockopt::linger, TAKE_BACK_MS);
        call.socket.send(zmq::str_buffer("not-lifting"), zmq::send_flags::dontwait);
        leaving_.push_back(std::move(call.socket));
        call.hang_up();
        if (leaving_.size() <= LEAVING_MAX) return;
        leaving_.front().set(zmq::sockopt::linger, 0);
        leaving_.pop_front();
    }

    // Reconnect the subscriber, and drop its waiting messages.
    void renew() {
        socket_.close();
        socket_ = connected(zmq::socket_type::sub, options_.endpoint);
    }

private:
    zmq::socket_t connected(zmq::socket_type kind, const std::string& endpoint) {
        auto made = uninterrupted([&] { return zmq::socket_t(context_, kind); });
        const auto set = [&made](auto option, const auto& value) {
            uninterrupted([&] { made.set(option, value); });
        };
        set(zmq::sockopt::linger, 0);
        set(zmq::sockopt::rcvhwm, QUEUE_MAX);
        set(zmq::sockopt::maxmsgsize, static_cast<std::int64_t>(MESSAGE_MAX_BYTES));
        if (options_.keys) {
            set(zmq::sockopt::curve_serverkey, options_.keys->server_key);
            set(zmq::sockopt::curve_publickey, options_.keys->public_key);
            set(zmq::sockopt::curve_secretkey, options_.keys->secret_key);
        }
        if (endpoint.rfind("tcp://", 0) == 0) {
            set(zmq::sockopt::ipv6, endpoint.find('[') != std::string::npos);
            set(zmq::sockopt::heartbeat_ivl, HEARTBEAT_MS);
            set(zmq::sockopt::heartbeat_timeout, HEARTBEAT_TIMEOUT_MS);
        }
        if (kind == zmq::socket_type::sub)
            set(zmq::sockopt::subscribe, "verdict." + options_.hand);
        else  // the name identifies the client, the number after it the connection
            set(zmq::sockopt::routing_id, name_ + std::to_string(++calls_));
        uninterrupted([&] { made.connect(endpoint); });
        return made;
    }

    // Random name, 16 bytes, with which routing ids begin; the first byte is not zero.
    static std::string random_name() {
        std::random_device random;
        std::string name = "g";
        while (name.size() < NAME_BYTES) name += static_cast<char>(random() & 0xffU);
        return name;
    }

    Options options_;
    zmq::context_t context_;
    std::string name_ = random_name();
    std::uint64_t calls_ = 0;
    zmq::socket_t socket_;
    std::deque<zmq::socket_t> leaving_;  // sockets whose last message is being sent

public:
    Call asking, telling, timing;  // closed before the context
};

// Deletes a link, but not in a forked process: ZeroMQ's thread is the parent's alone.
struct Owner {
    pid_t pid = getpid();

    bool is_here() const { return getpid() == pid; }

    void operator()(Link* link) const {
        if (is_here()) delete link;
    }
};

// Returns true if the newest message is older than the answer, or of another start of the daemon.
inline bool is_behind(const Verdict& newest, const Verdict& answer) {
    return newest.boot_id != answer.boot_id || !newest.seq || *newest.seq < *answer.seq;
}

// `may_i_lift`: asks one question at a time until the newest message confirms an answer that
// permits a lift.
class Question {
public:
    Question(Newest& newest, Link& link, bool asks, bool supervised,
             std::optional<double> still_ms)
        : newest_(newest), link_(link), asks_(asks), supervised_(supervised),
          still_ms_(still_ms) {}
    Question(const Question&) = delete;
    Question& operator=(const Question&) = delete;
    ~Question() {
        if (!asks_) return;
        try {
            if (!lifts_) link_.take_back(link_.asking);
        } catch (const zmq::error_t&) {  // it cannot be said; a person settles the lift
        }
        link_.asking.hang_up();
    }

    // Returns true if a verdict lets the hand lift.
    bool permits(const Verdict& said) const { return said || (supervised_ && said.supervised); }

    // Returns true for `slip` or a verdict that permits a lift: waiting can end.
    bool is_over(const Verdict& said) const {
        return said.decision == Decision::slip || permits(said);
    }

    // Returns the newest verdict if it confirms the answer, else an unknown one; asks if needed. An
    // answered `slip` is returned at once. Without an ask endpoint `newest` decides alone. A restart
    // of the daemon loses questions and voids answers, so another start is asked again; nothing is
    // asked before its first message.
    Verdict decided(Verdict newest) {
        newest = if_still(std::move(newest));
        if (!asks_) return newest;
        if (const auto payload = asked_ ? link_.asking.answer() : std::nullopt) {
            asked_ = false;
            heard_ = true;
            answer_ = newest_.answered(*payload);
            may_be_announced_ = newest_.may_be_announced;
            if (answer_) answer_ = if_still(*std::move(answer_));
            const bool permitted = answer_ && permits(*answer_);
            if (answer_ && answer_->decision == Decision::slip && !permitted) return *answer_;
            refusal_.reset();
            if (!permitted) refusal_.swap(answer_);
        }
        if (answer_ && !is_behind(newest, *answer_)) {
            if (permits(newest) && newest.grasp == answer_->grasp &&
                newest.supervised == answer_->supervised) {
                newest.owner = answer_->owner;
                return newest;
            }
            answer_.reset();
        }
        if (newest.seq && asked_of_ != newest.boot_id) {
            asked_ = false;
            answer_.reset();
            may_be_announced_ = asked_of_.has_value();
        }
        if (!asked_ && !answer_ && newest.seq) {
            if (may_be_announced_) link_.take_back(link_.asking);
            may_be_announced_ = false;
            asked_ = link_.ask(link_.asking, "lift");
            asked_of_ = newest.boot_id;
        }
        if (newest.decision == Decision::unknown && !permits(newest)) return newest;
        return refused(std::move(newest));
    }

    // Returns the verdict, with the reason `no-answer` too if it decides nothing and the daemon
    // answered no question.
    Verdict at_the_end(Verdict said) {
        lifts_ = permits(said);
        auto& why = said.reasons;
        if (asks_ && !heard_ && said.seq && !is_over(said) &&
            std::find(why.begin(), why.end(), "no-answer") == why.end())
            why.emplace_back("no-answer");
        return said;
    }

private:
    // Returns the newest verdict as unknown, with the reasons and the owner of the answer that
    // refused its grasp; without such an answer for its own reasons, or else `no-answer`.
    Verdict refused(Verdict newest) const {
        std::vector<std::string> why = newest.reasons;
        if (refusal_ && key(*refusal_) == key(newest)) {
            if (!refusal_->reasons.empty()) why = refusal_->reasons;
            newest.owner = refusal_->owner;
        }
        if (why.empty()) why.emplace_back("no-answer");
        return newest.unknown(std::move(why));
    }

    // Returns the verdict, as unknown if it permits a lift but the hand was not still long enough.
    // A lift under supervision must not be early; any lift needs `still_ms` of stillness.
    Verdict if_still(Verdict said) const {
        if (!permits(said)) return said;
        const bool still = !still_ms_ || (said.still_ms && *said.still_ms >= *still_ms_);
        return still && !(said.supervised && said.early) ? said : said.unknown({"not-still"});
    }

    Newest& newest_;
    Link& link_;
    bool asks_, supervised_, asked_ = false, heard_ = false;
    bool may_be_announced_ = false, lifts_ = false;
    std::optional<double> still_ms_;
    std::optional<std::string> asked_of_;  // start of the daemon that was asked last
    std::optional<Verdict> answer_;   // answer to be confirmed
    std::optional<Verdict> refusal_;  // last answer, if it permits no lift
};

}  // namespace detail

// Subscribes to the verdicts of one hand. Use it in one thread.
class Client {
public:
    // Throws `zmq::error_t` for a wrong endpoint, `std::invalid_argument` for an invalid age or
    // probability.
    explicit Client(const Options& options)
        : newest_("verdict." + options.hand, age_ns(options.max_age_ms),
                  options.same_computer.value_or(detail::is_same_computer(options.endpoint)),
                  probability(options.max_p_slip)),
          link_(new detail::Link(options)), max_age_ns_(age_ns(options.max_age_ms)),
          asks_(!options.ask_endpoint.empty()),
          compares_clocks_(asks_ && !options.same_computer.value_or(
                                        detail::is_same_computer(options.endpoint))),
          warn_(options.warn) {}

    const Counts& counts() const { return newest_.counts; }

    // Number of lifts, before the last allowed one, of which graspd has no outcome; it cannot
    // learn from them. With `[risk]` one that was asked for and is never reported counts as a slip.
    std::int64_t unreported() const {
        std::int64_t found = forgotten_;
        for (const auto& [grasp, told] : lifts_) found += !told && grasp != last_;
        return found;
    }

    // Returns the newest verdict; waits at most `wait_s` seconds for a new message. Throws
    // `std::invalid_argument` for an invalid time.
    Verdict verdict(double wait_s = 0.0) {
        return next_verdict(detail::now_ns() + duration_ns(wait_s));
    }

    // Returns whether the current grasp may be lifted, within `deadline_s` seconds from now.
    //
    // Waits for a fresh `stable` or `slip`. With an ask endpoint it asks the daemon, and the answer
    // and the newest message of the same grasp must both say `stable`; after an unknown answer it
    // asks again. Everything else until the deadline is a no. Pass `supervised` only while a person
    // watches: a grasp from which graspd asks to learn, in the warm-up and sometimes later, may
    // then be lifted if it is not `early`, and the answer has `supervised`. `still_ms`: time for
    // which the hand must have been still; a daemon that does not report it gets a no. Without it
    // `stable` is enough, even if `early`, because its scene allows that. Throws
    // `std::invalid_argument` for an invalid time.
    LiftAnswer may_i_lift(double deadline_s, bool supervised = false,
                          std::optional<double> still_ms = {}) {
        if (still_ms && !(*still_ms >= 0.0 && *still_ms <= REAL_MAX))
            throw std::invalid_argument("still_ms must be 0 or more, and finite");
        const Nanoseconds began_ns = detail::now_ns();
        const Nanoseconds due_ns = began_ns + duration_ns(deadline_s);
        detail::Question question(newest_, *link_, asks_ && is_here(), supervised, still_ms);
        Verdict decided = question.decided(verdict());
        while (!question.is_over(decided) && wait(due_ns)) {
            decided = question.decided(verdict());
            if (detail::now_ns() > due_ns && question.permits(decided))
                decided = decided.unknown({"late"});
        }
        decided = question.at_the_end(std::move(decided));
        const auto waited_ns = static_cast<double>(detail::now_ns() - began_ns);
        const LiftAnswer answer{decided, waited_ns / 1e9, supervised && decided.supervised};
        if (answer) allow(detail::key(decided));
        return answer;
    }

    // A time in the place of `supervised` would be mistaken for true.
    LiftAnswer may_i_lift(double deadline_s, double still_ms) = delete;

    // Returns the verdict on the next grasp once it is judged for sure; none if none is in time.
    //
    // Waits at most `deadline_s` seconds for a `stable` or `slip` of a grasp that this method has
    // not returned before. With `supervised` it also returns grasps to lift while a person watches.
    // It never returns an `early` verdict. It asks nothing: call `may_i_lift` before the lift.
    // Throws `std::invalid_argument` for an invalid time.
    std::optional<Verdict> wait_for_grasp(double deadline_s, bool supervised = false) {
        const Nanoseconds due_ns = detail::now_ns() + duration_ns(deadline_s);
        do {
            const Verdict said = next_verdict(due_ns);
            const bool is_judged =
                said.decision != Decision::unknown || (supervised && said.supervised);
            if (is_judged && !said.early && detail::key(said) != returned_) {
                returned_ = detail::key(said);
                return said;
            }
        } while (is_here() && detail::now_ns() < due_ns);
        return std::nullopt;
    }

    // Watch over a lift: wait until something slides, at most `timeout_s` seconds.
    // It ends at once when a finger has the state `slide`, when one that touched at first is
    // `free`, and when another grasp begins. It also ends when for `max_age_ms` no reading showed
    // that all fingers that touched at first still do, as something may slide unseen. Throws
    // `std::invalid_argument` for an invalid time.
    SlideAnswer wait_for_slide(double timeout_s) {
        const Nanoseconds began_ns = detail::now_ns();
        const Nanoseconds due_ns = began_ns + duration_ns(timeout_s);
        Nanoseconds sure_ns = began_ns;
        std::vector<std::string> touched;
        Key grasp;
        bool is_first = true;  // older messages are from before the lift
        while (true) {
            const Verdict newest = verdict();
            const Nanoseconds now_ns = detail::now_ns();
            const auto touching = detail::feeling(newest, FingerState::touch);
            auto felt = is_first ? decltype(newest_.passed){} : newest_.passed;
            is_first = false;
            for (const auto& [finger, state] : newest.fingers)
                if (state) felt.emplace(finger, *state);
            std::vector<std::string> sliding;
            for (const auto& [finger, state] : felt)
                if (state == FingerState::slide) sliding.push_back(finger);
            if (touched.empty()) {
                touched = touching;
                grasp = detail::key(newest);
            }
            const auto is_free = [&](const std::string& finger) {
                return felt.count({finger, FingerState::free}) > 0;
            };
            const bool lost = std::any_of(touched.begin(), touched.end(), is_free) ||
                              (!touching.empty() && detail::key(newest) != grasp);
            if (!touched.empty() && std::includes(touching.begin(), touching.end(),
                                                  touched.begin(), touched.end()))
                sure_ns = now_ns - std::llrint(newest.age_ms.value_or(0.0) * 1e6);
            const bool is_old = now_ns - sure_ns > max_age_ns_;
            const bool ends = !sliding.empty() || lost || is_old || !is_here();
            if (ends || !wait(due_ns))
                return {newest, static_cast<double>(now_ns - began_ns) / 1e9, sliding,
                        !touched.empty() && !ends};
        }
    }

    // Report how the lift made on a verdict ended, and the object's name (empty: not known). Report
    // `Outcome::not_lifted` if no lift followed a yes; otherwise graspd waits for an outcome.
    //
    // Waits at most `wait_s` seconds: graspd answers once the outcome is on its disk. Later calls
    // take in a late answer; without one, report again. Throws `std::invalid_argument` without an
    // ask endpoint, for a verdict without a grasp, for an invalid time, and for a name that is not
    // 1 to 64 letters (ASCII), digits, `_`, `-`, `.`, or that begins with one of the last two.
    OutcomeAnswer tell(const Verdict& lifted_on, Outcome how,
                       const std::string& object_name = {}, double wait_s = 2.0) {
        const std::string telling = detail::telling(lifted_on, how, object_name);
        if (!asks_) throw std::invalid_argument("an outcome needs an ask_endpoint");
        const Nanoseconds due_ns = detail::now_ns() + duration_ns(wait_s);
        if (!is_here()) return OutcomeAnswer{"other-process"};
        hear();
        link_->telling.hang_up();
        link_->ask(link_->telling, telling);
        told_.reset();
        telling_ = detail::key(lifted_on);
        if (how != Outcome::not_lifted) newest_.end(telling_);
        drain();
        while (!told_ && wait(due_ns)) drain();
        return told_.value_or(OutcomeAnswer{"no-answer"});
    }

private:
    // Returns true in the process that made the client, false in a fork of it.
    bool is_here() const { return link_.get_deleter().is_here(); }

    // Returns the newest verdict, at its age now; waits for a new message until `due_ns` at most.
    Verdict next_verdict(Nanoseconds due_ns) {
        if (!is_here()) return Verdict{}.unknown({"other-process"});
        while (!drain() && wait(due_ns)) {}
        if (behind_) return Verdict{}.unknown({"behind"});
        return newest_.at(detail::now_ns());
    }

    static Nanoseconds age_ns(double max_age_ms) {
        if (!(max_age_ms > 0.0)) throw std::invalid_argument("max_age_ms must be above 0");
        return duration_ns(max_age_ms / 1e3);
    }

    static double probability(double max_p_slip) {
        if (!(max_p_slip > 0.0 && max_p_slip <= 1.0))
            throw std::invalid_argument("max_p_slip must be above 0 and at most 1");
        return max_p_slip;
    }

    static Nanoseconds duration_ns(double seconds) {
        if (!(seconds >= 0.0 && seconds <= WAIT_MAX_S))
            throw std::invalid_argument("a time must be 0 s or more, and finite");
        return std::llrint(seconds * 1e9);
    }

    using Key = detail::Key;

    // Note that the hand may lift this grasp. The outcome of the lift before is now overdue.
    void allow(const Key& lift) {
        last_ = lift;
        const auto known = std::find_if(lifts_.begin(), lifts_.end(),
                                        [&](const auto& each) { return each.first == lift; });
        if (known == lifts_.end())
            lifts_.emplace_back(lift, false);
        else
            known->second = false;  // it was told as not lifted before
        if (lifts_.size() > LIFTS_MAX) {
            forgotten_ += !lifts_.front().second;
            lifts_.pop_front();
        }
        if (unreported() < warn_at_) return;
        warn_at_ = unreported() + WARN_EVERY;
        if (warn_)
            warn_(std::to_string(unreported()) +
                  " lifts were allowed, and their outcome not told");
    }

    // Take in the answer to an outcome, if it has arrived.
    void hear() {
        const auto payload = link_->telling.answer();
        if (!payload) return;
        link_->telling.hang_up();
        told_ = detail::taken(*payload);
        newest_.counts.malformed += !told_;
        if (!told_) told_ = OutcomeAnswer{"malformed"};
        for (auto& [grasp, told] : lifts_) told = told || (*told_ && grasp == telling_);
    }

    // Ask another computer's daemon for its clock if that is due, and take in the answer.
    void compare_clocks() {
        if (!compares_clocks_) return;
        const Nanoseconds now_ns = detail::now_ns();
        const auto payload = clock_asked_ns_ ? link_->timing.answer() : std::nullopt;
        if (payload) {
            const auto told_ns = detail::told_clock(*payload);
            if (told_ns) {
                newest_.compare_clocks(*clock_asked_ns_, *told_ns);
                clock_due_ns_ = *clock_asked_ns_ + CLOCK_EVERY_NS;
            }
            newest_.counts.malformed += !told_ns;
            clock_asked_ns_.reset();
        }
        if (now_ns < clock_due_ns_) return;
        // A late answer must not be mistaken for one to this question.
        if (clock_asked_ns_) link_->timing.hang_up();
        clock_asked_ns_ = now_ns;
        clock_due_ns_ = now_ns + CLOCK_RETRY_NS;
        link_->ask(link_->timing, "clock");
    }

    // Read waiting messages, at most `QUEUE_MAX`, without blocking; returns true if one was new.
    // Also takes in answers to outcomes and clock questions, and reconnects after a long silence.
    bool drain() {
        bool anything_new = false;
        const Nanoseconds heard_ns = forget_what_is_old();
        hear();
        compare_clocks();
        behind_ = true;
        newest_.passed.clear();
        for (int taken = 0; behind_ && taken < QUEUE_MAX; ++taken) {
            const Nanoseconds before_ns = detail::now_ns();
            if (link_->receive(frames_)) {
                std::vector<std::string_view> views;
                for (const zmq::message_t& frame : frames_) views.push_back(frame.to_string_view());
                heard_ns_ = detail::now_ns();
                anything_new |= newest_.take(views, empty_ns_, heard_ns_);
            } else {
                empty_ns_ = before_ns;
                behind_ = false;
            }
        }
        read_ns_ = detail::now_ns();
        if (heard_ns_ != heard_ns) {
            quiet_ns_ = QUIET_NS;
        } else if (read_ns_ - heard_ns > std::max(quiet_ns_, newest_.silence_ns())) {
            quiet_ns_ = std::min(2 * quiet_ns_, QUIET_MAX_NS);
            connect_anew();
        }
        return anything_new;
    }

    // Forgets the newest message after a sleep of the computer, during which the monotonic clock
    // stands still. Reconnects then, and after a long time without reading. Returns when the last
    // message or connection came, ns.
    Nanoseconds forget_what_is_old() {
        const Nanoseconds slept_ns = detail::slept_ns();
        const bool slept = slept_ns - slept_ns_ > SLEPT_NS;
        slept_ns_ = std::max(slept_ns_, slept_ns);
        if (slept) newest_.forget("slept");
        if (slept || detail::now_ns() - read_ns_ > READ_WITHIN_NS) connect_anew();
        return heard_ns_;
    }

    void connect_anew() {
        link_->renew();
        link_->timing.hang_up();
        clock_asked_ns_.reset();
        clock_due_ns_ = 0;
        empty_ns_ = heard_ns_ = detail::now_ns();
    }

    // Wait for a message, at most `SLICE_MS`; returns false from `due_ns` on and after a fork.
    bool wait(Nanoseconds due_ns) {
        const Nanoseconds left_ns = due_ns - detail::now_ns();
        if (left_ns <= 0 || !is_here()) return false;
        link_->wait(std::min<std::int64_t>(left_ns / 1'000'000, SLICE_MS));
        return true;
    }

    detail::Newest newest_;
    std::unique_ptr<detail::Link, detail::Owner> link_;
    Nanoseconds max_age_ns_;
    bool asks_, compares_clocks_;
    std::optional<Nanoseconds> clock_asked_ns_;
    Nanoseconds clock_due_ns_ = 0;
    std::function<void(const std::string&)> warn_;
    std::deque<std::pair<Key, bool>> lifts_;  // allowed lifts; true if graspd has the outcome
    Key last_, telling_;                      // last allowed one, and the one being reported
    Key returned_;                            // the grasp that `wait_for_grasp` returned last
    std::optional<OutcomeAnswer> told_;
    std::int64_t forgotten_ = 0, warn_at_ = 1;
    bool behind_ = false;
    Nanoseconds read_ns_ = detail::now_ns(), empty_ns_ = read_ns_, heard_ns_ = read_ns_;
    Nanoseconds quiet_ns_ = QUIET_NS, slept_ns_ = detail::slept_ns();
    std::vector<zmq::message_t> frames_;
};

}  // namespace graspd
