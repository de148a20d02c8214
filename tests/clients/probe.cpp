// The C++ client's rules, line by line, for comparison with the Python client's.
//
// `new MAX_AGE_NS SAME_COMPUTER` begins again; `take EMPTY_NS NOW_NS FRAME...` (hex, `-` is empty)
// takes a message; `clock ASKED_NS TOLD_NS` compares clocks; `end BOOT_ID GRASP` tells an outcome;
// `at NOW_NS` answers with a line. `client ENDPOINT ASK_ENDPOINT [MAX_AGE_MS]` makes one, `lift` asks it and
// answers with a line (`watch DEADLINE_S`: under supervision), `tell` tells it that the lift held
// (`slipped`: that it did not), `wait DEADLINE_S SUPERVISED` waits for a grasp,
// `slide TIMEOUT_S` watches over a lift.
#include "graspd_client.hpp"

#include <iostream>
#include <sstream>
#include <type_traits>

namespace {

std::string unhexed(const std::string& text) {
    std::string bytes;
    for (std::size_t i = 0; i + 1 < text.size(); i += 2)
        bytes.push_back(static_cast<char>(std::stoi(text.substr(i, 2), nullptr, 16)));
    return bytes;
}

void say(const graspd::Verdict& verdict, const graspd::Counts& counts) {
    std::cout << graspd::name(verdict.decision) << ' ' << verdict.reasons.size();
    for (const std::string& reason : verdict.reasons) std::cout << ' ' << reason;
    std::cout << ' ' << verdict.grasp.value_or(-1) << ' ' << verdict.seq.value_or(-1) << ' '
              << (verdict.boot_id.empty() ? "-" : verdict.boot_id) << ' '
              << std::llrint(verdict.age_ms.value_or(-1) * 1e6) << ' '
              << std::llrint(verdict.p_slip.value_or(-1) * 1e9) << ' '
              << std::llrint(verdict.p_slip_model.value_or(-1) * 1e9) << ' ' << verdict.outcomes
              << ' ' << verdict.supervised << ' ' << static_cast<bool>(verdict) << ' ';
    if (const auto& risk = verdict.risk)
        std::cout << std::llrint(risk->target.value_or(-1) * 1e9) << ' ' << risk->lifts << ' '
                  << risk->slips << ' ' << risk->outstanding << ' '
                  << std::llrint(risk->bound.value_or(-1)) << ' ' << risk->warm_up_left << ' '
                  << risk->announced << ' ' << risk->awaited << ' ';
    std::cout << verdict.early << verdict.owner << ' ' << std::llrint(verdict.still_ms.value_or(-1) * 1e6) << ' ';
    for (const auto& [finger, moves] : verdict.motion)
        std::cout << finger << '=' << std::llrint(moves.value_or(-1) * 1e3) << ' ';
    for (const auto& [finger, limit] : verdict.motion_limits)
        std::cout << finger << '<' << std::llrint(limit * 1e3) << ' ';
    for (const auto& [finger, felt] : verdict.fingers)
        std::cout << finger << '-' << (felt ? graspd::name(*felt) : "unknown") << ' ';
    std::cout << counts.messages << ' '
              << counts.lost << ' ' << counts.repeats << ' ' << counts.malformed << ' '
              << counts.restarts << ' ' << counts.former << std::endl;
}

}  // namespace

static_assert(std::is_move_constructible_v<graspd::Client>, "a client can be moved");

int main() {
    graspd::detail::Newest newest("verdict.right", 0, true);
    std::optional<graspd::Client> client;
    graspd::LiftAnswer answer;
    for (std::string line; std::getline(std::cin, line);) {
        std::istringstream words(line);
        std::string order;
        words >> order;
        if (order == "new") {
            graspd::Nanoseconds max_age_ns = 0;
            bool same_computer = false;
            words >> max_age_ns >> same_computer;
            newest = graspd::detail::Newest("verdict.right", max_age_ns, same_computer);
        } else if (order == "take") {
            graspd::Nanoseconds empty_ns = 0, now_ns = 0;
            words >> empty_ns >> now_ns;
            std::vector<std::string> frames;
            for (std::string frame; words >> frame;) frames.push_back(unhexed(frame));
            newest.take({frames.begin(), frames.end()}, empty_ns, now_ns);
        } else if (order == "clock") {
            graspd::Nanoseconds asked_ns = 0, told_ns = 0;
            words >> asked_ns >> told_ns;
            newest.compare_clocks(asked_ns, told_ns);
        } else if (order == "end") {
            graspd::detail::Key grasp;
            words >> grasp.first >> grasp.second;
            newest.end(grasp);
        } else if (order == "client") {
            graspd::Options options;
            words >> options.endpoint >> options.ask_endpoint;
            double max_age_ms = 0.0;
            if (words >> max_age_ms) options.max_age_ms = max_age_ms;
            options.warn = [](const std::string& text) {
                std::cout << "warn " << text << std::endl;
            };
            client.emplace(options);
        } else if (order == "wait") {
            double deadline_s = 0.0;
            bool supervised = false;
            words >> deadline_s >> supervised;
            const auto found = client.value().wait_for_grasp(deadline_s, supervised);
            std::cout << (found ? found->grasp.value_or(0) : -1) << std::endl;
        } else if (order == "lift" || order == "watch") {
            double deadline_s = 30.0;
            words >> deadline_s;
            answer = client.value().may_i_lift(order == "lift" ? 30.0 : deadline_s, order == "watch");
            std::cout << static_cast<bool>(answer) << ' ' << answer.verdict.grasp.value_or(0) << ' '
                      << client->unreported() << std::endl;
        } else if (order == "slide") {
            double timeout_s = 0.0;
            words >> timeout_s;
            const graspd::SlideAnswer slide = client.value().wait_for_slide(timeout_s);
            std::cout << static_cast<bool>(slide) << ' ' << slide.held;
            for (const std::string& finger : slide.sliding) std::cout << ' ' << finger;
            std::cout << std::endl;
        } else if (order == "tell" || order == "slipped") {
            const auto how = order == "tell" ? graspd::Outcome::held : graspd::Outcome::slipped;
            const bool taken{client.value().tell(answer.verdict, how, {}, 30.0)};
            std::cout << (taken ? "told" : "not taken") << std::endl;
        } else {
            graspd::Nanoseconds now_ns = 0;
            words >> now_ns;
            say(newest.at(now_ns), newest.counts);
        }
    }
}
