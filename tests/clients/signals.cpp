// `signals CALLS`: signals interrupt this number of calls, then a forked process uses the client.
#include "graspd_client.hpp"

#include <csignal>
#include <cstdlib>
#include <iostream>
#include <sys/time.h>
#include <sys/wait.h>

int main(int, char** argv) {
    graspd::Options options;
    options.endpoint = "tcp://127.0.0.1:9";
    options.ask_endpoint = "tcp://127.0.0.1:9";
    std::optional<graspd::Client> client(options);
    struct sigaction action {};
    action.sa_handler = [](int) {};
    sigaction(SIGALRM, &action, nullptr);
    itimerval often{{0, 100}, {0, 100}};
    setitimer(ITIMER_REAL, &often, nullptr);
    for (int i = 0; i < std::atoi(argv[1]); ++i) client->may_i_lift(0.001);
    itimerval never{};
    setitimer(ITIMER_REAL, &never, nullptr);
    if (fork() == 0) {
        for (const auto& said : {client->verdict(1e6), client->may_i_lift(1e6).verdict,
                                 client->wait_for_slide(1e6).verdict})
            std::cout << name(said.decision) << ' ' << said.reasons.at(0) << '\n';
        std::cout << client->wait_for_grasp(1e6).has_value() << '\n';
        graspd::Verdict lifted;
        lifted.boot_id = "a", lifted.grasp = 1;
        std::cout << client->tell(lifted, graspd::Outcome::held, {}, 1e6).why << '\n';
        client.reset();
        std::cout.flush();
        _exit(0);  // its copy of the sockets is left as it is
    }
    int status = 0;
    wait(&status);
    std::cout << "status " << status << '\n';
    return 0;
}
